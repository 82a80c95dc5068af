"""Median over interleaved pairs of our rays per second over the prototype's and Embree's (fast mode), of the CPU of building the tree over
Embree's (medium quality, two threads each), and of how much sooner two threads have built it than one, each with its 95 % interval."""
import argparse
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

from measure import interval

GRID = {"1M": 148, "8M": 419}
SETS = ["primary", "bounce1", "bounce2", "shadow"]
# rays in flight, prefetch, nearest child first; any-hit is faster without the order
CLOSEST, ANY = "32:ps:", "32:p:"


def output(command: list, **env: str) -> str:
    return subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True, env={**os.environ, **env}).stdout


def built(line: str, out: str) -> list:
    """Wall and CPU seconds of a build, as one of these programs says them."""
    m = re.search(line + r" build.* wall ([\d.]+).* cpu ([\d.]+)", out) or sys.exit(f"no build in:\n{out}")
    return [float(m[1]), float(m[2])]


def ours(kernel: Path, folder: Path, repetitions: int, threads: int = 2) -> tuple:
    out = output([kernel, folder, repetitions, 1, "auto"], RAYON_NUM_THREADS=str(threads))
    return built("blocks:", out), {m[1]: float(m[2]) for m in re.finditer(r"^(\w+) +Avx\w+ +median +[\d.]+ best +([\d.]+)", out, re.M)}


def theirs(prototype: Path, folder: Path, repetitions: int) -> tuple:
    out = output([prototype, folder, "-r", repetitions, "-v", f"{CLOSEST},{ANY}"])
    found, embree, name = {}, {}, ""
    for line in out.splitlines():
        if m := re.match(r"(\w+) +embree ([\d.]+)", line):
            name = m[1]
            embree[name] = float(m[2])
        elif m := re.match(r" +(\S+) +([\d.]+) Mrays/s", line):
            if m[1] == (ANY if name == "shadow" else CLOSEST):
                found[name] = float(m[2])
    return found, embree, built("embree fast", out)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--kernel", type=Path, required=True)
    p.add_argument("--prototype", type=Path, required=True)
    p.add_argument("--shared", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--pairs", type=int, default=10)
    p.add_argument("--repetitions", type=int, default=3)
    p.add_argument("--triangles", default="8M,1M")
    a = p.parse_args()
    prototype = next(f for f in a.prototype.iterdir() if f.is_file() and f.stat().st_mode & 0o111 and f.suffix == "")
    for size in a.triangles.split(","):
        work = a.work.resolve() / size
        folder = work / "scenes"
        if not (folder / "shadow.rays").exists():
            work.mkdir(parents=True, exist_ok=True)
            subprocess.run([sys.executable, a.shared.resolve() / "peers/make_scene.py", str(GRID[size])], cwd=work, check=True, stdout=subprocess.DEVNULL)
            output([a.kernel, "rays", folder])
        over = {(s, peer): [] for s in SETS for peer in ("prototype", "embree")}
        builds, sooner = [], []
        for pair in range(a.pairs):
            build, mine = ours(a.kernel, folder, a.repetitions)
            alone, _ = ours(a.kernel, folder, 1, threads=1)
            proto, embree, its_build = theirs(prototype, folder, a.repetitions)
            builds.append(build[1] / its_build[1])
            sooner.append(alone[0] / build[0])
            for s in SETS:
                over[s, "prototype"].append(mine[s] / proto[s])
                over[s, "embree"].append(mine[s] / embree[s])
            print(f"{size} pair {pair}: " + ", ".join(f"{s} {mine[s]:.2f} / {proto[s]:.2f} / {embree[s]:.2f}" for s in SETS), flush=True)
            print(f"{size} pair {pair}: build {build[1]:.2f} / {its_build[1]:.2f} CPU s; wall {alone[0]:.2f} s on one thread, {build[0]:.2f} s on two", flush=True)
        for what, ratios in ("CPU of build over embree's", builds), ("wall of our build on one thread over two", sooner):
            lo, hi = interval(ratios)
            print(f"{size} {what}: median {statistics.median(ratios):.3f}, 95 % interval {lo:.3f} to {hi:.3f}", flush=True)
        for (s, peer), ratios in over.items():
            lo, hi = interval(ratios)
            print(f"{size} {s} over {peer}: median {statistics.median(ratios):.3f}, 95 % interval {lo:.3f} to {hi:.3f}", flush=True)


if __name__ == "__main__":
    main()
