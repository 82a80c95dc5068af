"""Error against time: the same scene at the same depth by several renderers, interleaved, whole processes.

Error is relMSE = mean((I - R)^2 / (R^2 + 0.01)) with the reference's own noise subtracted; the reference is Mitsuba's, in two halves, so that its
noise is known. Time is CPU seconds of a process from its start (all threads), its wall seconds beside it, and the CPU of rendering alone. Each
renderer is used as it comes; Mitsuba's kernel cache is filled first. Cycles (by_cycles.py) runs with its light tree and without. Ours runs twice: with
so many samples a pixel, as the others, and asked for an error (`--target-error`), as who wants one would; its error is measured as the others' is.
"""
import argparse
import csv
import datetime
import json
import math
import platform
import re
import sys
from pathlib import Path

import numpy as np

import scenes
from measure import figure, run, save

SIZE = 256
# where peers are compared at equal error: light behind a door takes any of them minutes to 0.01
TARGETS = {"cornell": 0.001, "ajar-door": 0.02}
TARGET = 0.01
# a reference's noise, as relMSE, over the error at which renderers are compared; it is known from its halves and subtracted
QUIET = 0.1
# pixels of 65,536 that are left out of the error of each picture, the worst of it. One pixel of veach-mis shows a two-thousandth part of its smallest light: a render of
# 16 samples hits it once in 120 times and is then wrong by a relMSE of 0.24, by whatever renderer, which would decide the mean of any number of repeats
WORST = {"veach-mis": 16}
# from which ray on Mitsuba's roulette ends paths where its 5 is not its best: error times CPU from 2, 3, 4, 5 and 8 on was tried on these two (docs/benchmarks/tried.md)
RR_DEPTH = {"living-room": 2, "staircase": 4}
# ours when an error is asked for
ASKED = "rayherd-target"
# sets of repeats from which an interval is made
DRAWS = 1000
SCENES = ["cornell", "gyroid", "staircase", "living-room", "veach-mis", "classroom", *scenes.MANY_LIGHTS, "ajar-door"]
# Mitsuba takes hours to a reference of these: theirs is Rayherd's, of other seeds; that the means agree is for tests/accuracy/run to show
OWN_REFERENCE = {*scenes.MANY_LIGHTS, "ajar-door", "living-room", "classroom"}
# whose surfaces and lamps Cycles has too
FOR_CYCLES = {"cornell", "gyroid", *scenes.MANY_LIGHTS}

MITSUBA = """
import resource, sys, numpy as np, mitsuba as mi
variant, xml, spp, seed, out, depths = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5], sys.argv[6]
mi.set_variant(variant)
def cpu():
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
scene = mi.load_file(xml, **dict(kv.split('=') for kv in sys.argv[7:]))
max_depth, rr_depth = map(int, depths.split(','))
integrator = mi.load_dict({'type': 'path', 'max_depth': max_depth, 'rr_depth': rr_depth}) if rr_depth else None
start = cpu()
image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), dtype=np.float32)[:, :, :3]
print(cpu() - start)
np.save(out, image)
"""


class Renderer:
    def __init__(self, name: str, variant: str | None):
        self.name, self.variant = name, variant

    def is_cycles(self) -> bool:
        return self.name.startswith("cycles")

    def is_ours(self) -> bool:
        return self.variant is None

    def settings(self, a, target: float) -> list:
        """What it is run with: samples a pixel, or errors that are asked for."""
        return [target * e for e in a.asked] if self.name == ASKED else a.spp

    def render(self, a, name: str, xml: Path, setting, seed: int) -> dict:
        """CPU, wall and CPU without start and loading, and the image."""
        spp, asked = (a.most_spp, ["--target-error", setting]) if self.name == ASKED else (setting, [])
        out, report = a.work / f"bench-{self.name}.npy", a.work / "bench.json"
        if self.is_cycles():
            told, exr, here = a.work / f"{name}-cycles.npz", a.work / "bench-cycles.exr", Path(__file__).with_name("by_cycles.py")
            if not told.exists():
                values = [f"{k}={v}" for k, v in scenes.parameters(xml, SIZE, a.max_depth).items()]
                run([sys.executable, here, "export", xml, told, *values])
            cpu, wall, text = run([sys.executable, here, "render", told, exr, SIZE, spp, seed, a.max_depth, int(self.variant == "tree")])
            return {"cpu": cpu, "wall": wall, "render": float(text.split()[-1]), "image": read_exr(exr)}
        if self.is_ours():
            exr = a.work / "bench.exr"
            command = [a.rayherd, "render", str(xml), "--size", f"{SIZE}x{SIZE}", "--spp", str(spp), "--seed", str(seed),
                       "--max-depth", str(a.max_depth), "-o", str(exr), "--report", str(report), *asked]
        else:
            values = scenes.parameters(xml, SIZE, a.max_depth)
            command = [sys.executable, "-c", MITSUBA, self.variant, str(scenes.read_by_mitsuba(xml)), str(spp), str(seed), str(out),
                       f"{a.max_depth},{RR_DEPTH.get(name, 0)}"]
            command += [f"{k}={v}" for k, v in values.items()]
        cpu, wall, text = run(command)
        if self.is_ours():
            r = json.loads(report.read_text())
            if asked and not r["target_reached"]:
                raise SystemExit(f"{name}: {a.most_spp} samples a pixel do not reach {setting}: give --most-spp more")
            tracing = sum(node["busy"] for node in r["nodes_detail"])
            return {"cpu": cpu, "wall": wall, "render": tracing, "spp": round(r["samples"] / SIZE ** 2), "image": read_exr(exr)}
        return {"cpu": cpu, "wall": wall, "render": float(text.split()[-1]), "image": np.load(out).astype(np.float64)}


RENDERERS = [Renderer("rayherd", None), Renderer(ASKED, None), Renderer("llvm", "llvm_ad_rgb"), Renderer("scalar", "scalar_rgb")]
CYCLES = [Renderer("cycles-tree", "tree"), Renderer("cycles", "plain")]


def read_exr(path: Path) -> np.ndarray:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    return np.array(bitmap).astype(np.float64)


def reference(a, name: str, xml: Path, target: float) -> dict:
    """An image in two halves, whose noise is below a tenth of the error that is asked for; made once, kept in the cache."""
    known = a.shared / f"peers/refs/ref_{name}.npz"
    path = known if known.exists() and a.max_depth == 8 else a.work / f"ref_{name}_d{a.max_depth}.npz"
    if path.exists():
        r = dict(np.load(path))
        if path == known or noise(r) < QUIET * target:
            return r
    renderer, sums, counts, spp = next(r for r in RENDERERS if r.name == ("rayherd" if name in OWN_REFERENCE else "llvm")), [0.0, 0.0], [0, 0], 1024
    for i in range(64):
        sums[i % 2] = sums[i % 2] + renderer.render(a, name, xml, spp, 100_000 + i)["image"]
        counts[i % 2] += 1
        if i % 2:
            halves = [s / n for s, n in zip(sums, counts)]
            r = {"ref": (halves[0] + halves[1]) / 2, "A": halves[0], "B": halves[1]}
            print(f"{name}: reference of {(i + 1) * spp} spp, noise {noise(r):.2e}", flush=True)
            np.savez(path, **r)
            if noise(r) < QUIET * target:
                break
    return r


def noise(r: dict) -> float:
    return float(np.mean((r["A"] - r["B"]) ** 2 / 4 / (r["ref"] ** 2 + 0.01)))


def error(r: dict, image: np.ndarray, worst: int = 0) -> float:
    """relMSE of a picture, of whose pixels so many of the worst are left out."""
    pixels = np.mean((image - r["ref"]) ** 2 / (r["ref"] ** 2 + 0.01), axis=2).ravel()
    return float(np.mean(np.sort(pixels)[: pixels.size - worst])) - noise(r)


def at_error(points: list, target: float) -> float | None:
    """Seconds to an error, between the two measured points around it on a log-log line; None when it is not between two."""
    points = sorted((e, t) for t, e in points if e > 0)
    for (e0, t0), (e1, t1) in zip(points, points[1:]):
        if e0 <= target <= e1:
            f = math.log(target / e0) / math.log(e1 / e0) if e1 > e0 else 0.0
            return math.exp(math.log(t0) + f * (math.log(t1) - math.log(t0)))
    return None


def told(points: list, target: float) -> str:
    """Seconds to an error, or what is known where no two points lie around it."""
    seconds = at_error(points, target)
    if seconds is not None:
        return f"{seconds:.2f} CPU-s"
    time, least = min(points, key=lambda p: p[1])
    return f"more than {time:.2f} CPU-s (relMSE {least:.2e} there)" if least > target else f"less than {min(t for t, _ in points):.2f} CPU-s"


def points(rows: list, key: str, repeats: list | None = None) -> list:
    """Median time and mean error of each setting, of all repeats or of the named ones, each as often as it is named."""
    rows = rows if repeats is None else [r for k in repeats for r in rows if r["repeat"] == k]
    settings = {}
    for r in rows:
        # an error that is asked for takes other samples in each repeat
        settings.setdefault(-r["asked"] or r["spp"], []).append(r)
    return [(float(np.median([r[key] for r in of])), float(np.mean([r["rel_mse"] for r in of]))) for _, of in sorted(settings.items())]


def ratio(mine: list, theirs: list, key: str, repeats: list, target: float) -> tuple:
    """Our time to the error over the peer's, None where one of them does not bracket it. True beside it where the peer's longest run did not get there
    and stands for its time: the true ratio is smaller then."""
    a, curve = at_error(points(mine, key, repeats), target), points(theirs, key, repeats)
    b, below = at_error(curve, target), False
    if b is None and min(e for _, e in curve) > target:
        b, below = max(t for t, _ in curve), True
    return (None if a is None or b is None else a / b), below


def compare(rows: list, scene: str, target: float) -> list:
    """Our time to the error over each peer's, for CPU from process start, CPU of rendering alone and wall seconds, with the interval that holds 95 % of the
    ratios of `DRAWS` sets of repeats drawn from those that were run (bootstrap): errors are means over repeats, since a rare bright path makes one
    repeat's error say little.
    """
    by = {}
    for r in rows:
        if r["scene"] == scene:
            by.setdefault(r["renderer"], []).append(r)
    ours = [r.name for r in RENDERERS if r.is_ours() and r.name in by]
    out = []
    for name, peer in [(n, p) for n in ours for p in by if p not in ours]:
        mine, theirs = by[name], by[peer]
        repeats = sorted({r["repeat"] for r in mine})
        for key in ("cpu_s", "render_cpu_s", "wall_s"):
            value, below = ratio(mine, theirs, key, repeats, target)
            if value is None:
                continue
            rng = np.random.default_rng(1)
            drawn = [ratio(mine, theirs, key, list(rng.choice(repeats, len(repeats))), target) for _ in range(DRAWS)]
            # a set of repeats that does not bracket the error says nothing but that the bracket is narrow
            known = [r for r, _ in drawn if r is not None]
            low, high = np.percentile(known, [2.5, 97.5])
            out.append({"scene": scene, "ours": name, "peer": peer, "of": key, "rel_mse": target, "repeats": len(repeats), "below": below, "ratio": round(value, 4),
                        "low": round(float(low), 4), "high": round(float(high), 4), "unbracketed": DRAWS - len(known)})
    return out


def merge(path: Path, rows: list, key: str) -> list:
    """What the file has of other scenes, and the new rows, written back: scenes may be measured in several runs of a day."""
    new = {r[key] for r in rows}
    kept = []
    if path.exists():
        with open(path, newline="") as f:
            # a file of other columns is of an older version of this program
            kept = [r for r in csv.DictReader(f) if r[key] not in new and set(r) == set(rows[0])]
    for r in kept:
        for k, v in r.items():
            if isinstance(rows[0][k], bool):
                r[k] = v == "True"
            elif not isinstance(rows[0][k], str):
                r[k] = type(rows[0][k])(v)
    rows = kept + rows
    with open(path, "w", newline="") as f:
        w = csv.DictWriter(f, rows[0])
        w.writeheader()
        w.writerows(rows)
    return rows


def plot(rows: list, path: Path) -> None:
    from matplotlib import ticker

    names = list(dict.fromkeys(r["scene"] for r in rows))
    drawn, axes = figure(2, len(names), (4.5 * len(names), 8))
    for column, scene in enumerate(names):
        for row, (key, label) in enumerate([("cpu_s", "CPU-seconds from process start"), ("wall_s", "wall seconds from process start")]):
            ax = axes[row][column]
            # of all renderers, so that one has the same colour in each plot
            for number, renderer in enumerate(dict.fromkeys(r["renderer"] for r in rows)):
                mine = [r for r in rows if r["scene"] == scene and r["renderer"] == renderer]
                if mine:
                    curve = points(mine, key)
                    ax.loglog([t for t, _ in curve], [e for _, e in curve], "o-", color=f"C{number}", label=renderer)
            ax.axhline(TARGETS.get(scene, TARGET), color="grey", linestyle=":")
            ax.set(title=scene, xlabel=label, ylabel="relMSE")
            ax.grid(True, alpha=0.3)
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter("{x:g}")
                axis.set_minor_locator(ticker.NullLocator())
            ax.legend()
    save(drawn, path)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", default=SCENES)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--shared", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--results", type=Path, required=True)
    p.add_argument("--spp", default="16,64,256,1024", type=lambda s: [int(x) for x in s.split(",")])
    p.add_argument("--asked", default="2,1,0.5", type=lambda s: [float(x) for x in s.split(",")], help="errors asked of ours, in units of that at which renderers are compared")
    p.add_argument("--most-spp", type=int, default=65536, help="most samples a pixel where an error is asked for")
    p.add_argument("--repeats", type=int, default=3)
    p.add_argument("--max-depth", type=int, default=8)
    p.add_argument("--without", action="append", default=[], help=f"a renderer to leave out: {ASKED}, llvm, scalar, cycles-tree or cycles")
    p.add_argument("--cycles", action="store_true", help=f"Cycles too, where it has what the scene has: {', '.join(sorted(FOR_CYCLES))}")
    a = p.parse_args()
    a.work, a.shared = a.work.resolve(), a.shared.resolve()
    a.work.mkdir(parents=True, exist_ok=True)
    a.results.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in a.names:
        xml = scenes.prepare(name, a.shared, a.work, a.rayherd)
        target = TARGETS.get(name, TARGET)
        ref = reference(a, name, xml, target)
        renderers = [r for r in RENDERERS if r.name not in a.without]
        if a.cycles and name in FOR_CYCLES:
            renderers += [r for r in CYCLES if r.name not in a.without]
        for r in renderers:
            if r.name != ASKED:
                r.render(a, name, xml, 1, 0)  # fills kernel and page caches
        for repeat in range(a.repeats):
            # settings of all renderers in turn; who has fewer of them is done sooner
            for k, (r, setting) in sorted(((k, (r, s)) for r in renderers for k, s in enumerate(r.settings(a, target))), key=lambda of: of[0]):
                got = r.render(a, name, xml, setting, 12_345 + 7919 * repeat + 16 * 4 ** k)
                row = {"scene": name, "renderer": r.name, "spp": got.get("spp", setting), "asked": setting if r.name == ASKED else 0.0, "repeat": repeat,
                       "cpu_s": round(got["cpu"], 3), "wall_s": round(got["wall"], 3), "render_cpu_s": round(got["render"], 3),
                       "rel_mse": error(ref, got["image"], WORST.get(name, 0)), "mean": float(got["image"].mean())}
                rows.append(row)
                print("{scene} {renderer} {spp} spp: {cpu_s:.2f} CPU-s ({render_cpu_s:.2f} without load), relMSE {rel_mse:.3e}".format(**row), flush=True)
        for r in renderers:
            mine = [x for x in rows if x["scene"] == name and x["renderer"] == r.name]
            print(f"{name} to relMSE {target}: {r.name} {told(points(mine, 'cpu_s'), target)}")
        for c in compare(rows, name, target):
            print("{scene}: {ours}, {of} to relMSE {rel_mse} over {peer}'s: {0}{ratio:.3f} ({low:.3f} to {high:.3f}, {repeats} repeats)".format("below " * c["below"], **c), flush=True)
    machine = next((l.split(":")[1].strip() for l in open("/proc/cpuinfo") if l.startswith("model name")), platform.machine())
    # without the marks of trade that some have
    words = re.sub(r"\([^)]*\)", "", machine).split()
    stem = a.results / f"{datetime.date.today()}-{'-'.join(words[:2])}"
    ratios = [c for name in a.names for c in compare(rows, name, TARGETS.get(name, TARGET))]
    rows = merge(Path(f"{stem}.csv"), rows, "scene")
    if ratios:
        merge(Path(f"{stem}-ratios.csv"), ratios, "scene")
    plot(rows, Path(f"{stem}.svg"))
    print(f"written to {stem}.csv, -ratios.csv and .svg")


if __name__ == "__main__":
    main()
