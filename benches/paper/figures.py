"""The paper's figures with virtual nodes: what each strategy reads, computes and would wait for.

Fig. 4: one frame and several, preparing apart. Fig. 5: 2, 4 and 8 nodes. Fig. 6: larger scenes, made by dividing each triangle into four and by
copies side by side. Fig. 7: each node's CPU and reads. Nodes have 2 and 4 slots by halves, as in the paper's Table I, R = 2, and memory for four
splits of the chest scan.

All nodes share this machine, so its clock says nothing of a cluster. What is measured is CPU and bytes; `modelled_s` is made of both: of the
slowest node, the CPU of its tasks over its slots, and what it read from others at the paper's 1 Gb/s. All strategies must leave the same file, and
demand driven must read most and the reduced grid least, or the command fails; what lost is printed too.
"""
import argparse
import csv
import datetime
import functools
import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import measure  # noqa: E402

STRATEGIES = {"demand-driven": "DD", "scheduling-grid": "SG without OR", "scheduling-grid-overlap-reduced": "SG with OR", "auto": "auto"}
ISO = {"chest": -789.5, "head": 1150.5}
# bytes a second
NETWORK = 125e6
FIELDS = ["figure", "scene", "strategy", "nodes", "frames", "repeat", "triangles", "prepare_source", "prepare_written", "passes", "remote",
          "network", "rounds", "hops", "cpu_s", "modelled_s"]


def slots(nodes: int) -> str:
    return ",".join(["2"] * (nodes // 2) + ["4"] * (nodes - nodes // 2))


def known(path: Path) -> list:
    """The rows of a file that this program has written."""
    words = {"scene", "strategy", "prepare_written"}
    with open(path, newline="") as f:
        return [{k: v if k in words else int(v) if v.isdigit() else float(v) for k, v in r.items()} for r in csv.DictReader(f)]


class Bench:
    def __init__(self, a):
        self.a, self.rows, self.sums, self.nodes, self.prepared, self.reports = a, [], {}, [], {}, {}

    def scene(self, name: str) -> tuple:
        """Path and flags of a scene."""
        folder = self.a.data
        if name == "chest":
            return [str(folder / "ct-lidc-0314" / "dicom"), "--iso", str(ISO["chest"])]
        head = [str(folder / "ct-headsq-quarter" / "quarter.nhdr"), "--iso", str(ISO["head"])]
        if name == "head":
            return head
        kind, n = name.split("-")[1], int(name.split("-")[2])
        ply = self.a.work / f"{name}.ply"
        if not ply.exists():
            made = {"divided": ["subdivide", "--levels", str(n)], "copied": ["replicate", "--copies", f"{n},{n},1", "--step", "220,220,0"]}[kind]
            command = [self.a.rayherd, "scene", made[0], head[0], "--iso", str(ISO["head"]), "-o", str(ply), *made[1:]]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return [str(ply)]

    def frame(self, scene: str, strategy: str, nodes: int, seed: int, repeat: int, memory: str) -> dict:
        """The report of a frame; what several figures show is rendered once."""
        key = (scene, strategy, nodes, seed, repeat, memory)
        if key in self.reports:
            return self.reports[key]
        a = self.a
        out, report = a.work / "paper.exr", a.work / "paper.json"
        # what was prepared is kept, the picture is made anew
        store = self.store(scene, strategy)
        shutil.rmtree(store / "jobs", ignore_errors=True)
        command = [a.rayherd, "render", *self.scene(scene), "--splits", "32", "--size", a.size, "--spp", str(a.spp), "--nodes", str(nodes),
                   "--slots", slots(nodes), "--replicas", str(min(2, nodes)), "--memory", memory, "--strategy", strategy,
                   "--seed", str(seed), "--store", str(store), "--report", str(report), "-o", str(out)]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        r = json.loads(report.read_text())
        digest = hashlib.sha256(out.read_bytes()).hexdigest()
        if self.sums.setdefault((scene, seed), digest) != digest:
            raise SystemExit(f"{scene} by {strategy} on {nodes} nodes is another picture")
        if not r["prepare"]["reused"]:
            self.prepared[store] = sum(b["bytes"] for b in r["prepare"]["took"]["bytes"] if b["op"] == "write")
        self.reports[key] = r
        return r

    def store(self, scene: str, strategy: str) -> Path:
        return self.a.work / f"store-{scene}-{strategy}"

    def render(self, figure: int, scene: str, strategy: str, nodes: int, frames: int, repeat: int) -> dict:
        memory = self.a.memory_of_sizes if figure == 6 else self.a.memory
        # the frames of a job read one prepared scene: each begins with the nodes' memories empty, as a job's first round does
        all_frames = [self.frame(scene, strategy, nodes, seed, repeat, memory) for seed in range(frames)]
        total = functools.reduce(add, all_frames)
        busiest = max(n["busy"] / n["slots"] + n["remote_reads"] / NETWORK for n in total["nodes_detail"])
        row = dict(zip(FIELDS, [figure, scene, STRATEGIES[strategy], nodes, frames, repeat, total["prepare"]["counts"]["triangles"],
                                total["prepare"]["counts"]["source_bytes"], self.prepared.get(self.store(scene, strategy), ""), total["scene_passes"], total["remote_ratio"],
                                total["network_bytes"], total["rounds"], total["hops"], sum(n["busy"] for n in total["nodes_detail"]),
                                busiest]))
        self.rows.append(row)
        print(f"fig. {figure}: {scene}, {row['strategy']}, {nodes} nodes, {frames} frames: {row['passes']:.2f} passes, remote "
              f"{row['remote']:.3f}, {row['network'] / 1e6:,.0f} MB, {row['cpu_s']:.1f} CPU-s, modelled {row['modelled_s']:.1f} s", flush=True)
        return total


def add(a: dict, b: dict) -> dict:
    """Two frames together."""
    nodes = [{**x, **{k: x[k] + y[k] for k in ("busy", "reads", "remote_reads")}} for x, y in zip(a["nodes_detail"], b["nodes_detail"])]
    reads = a["scene_passes"] + b["scene_passes"]
    remote = (a["remote_ratio"] * a["scene_passes"] + b["remote_ratio"] * b["scene_passes"]) / reads if reads else 0.0
    sums = {k: a[k] + b[k] for k in ("scene_passes", "network_bytes", "rounds", "hops")}
    return {**a, **sums, "remote_ratio": remote, "nodes_detail": nodes}


def plot(bench: Bench, path: Path) -> None:
    drawn, axes = measure.figure(2, 2, (13, 9))
    of = lambda n: [r for r in bench.rows if r["figure"] == n]  # noqa: E731
    names = list(STRATEGIES.values())
    for axis, n, key, label in ((axes[0][0], 4, "frames", "frames"), (axes[0][1], 5, "nodes", "nodes"), (axes[1][0], 6, "triangles", "triangles")):
        for name in names:
            points = {}
            for r in of(n):
                if r["strategy"] == name:
                    points.setdefault(r[key], []).append(r["modelled_s"])
            x = sorted(points)
            axis.plot(x, [sorted(points[i])[len(points[i]) // 2] for i in x], marker="o", label=name)
        axis.set(title=f"as Fig. {n}", xlabel=label, ylabel="modelled seconds of the slowest node", yscale="log")
        if n == 6:
            axis.set_xscale("log")
        axis.legend()
    for i, (name, nodes) in enumerate(bench.nodes):
        reads = [n["reads"] / 1e6 for n in nodes]
        axes[1][1].bar([k + 0.2 * i for k in range(len(reads))], reads, width=0.2, label=name)
    axes[1][1].set(title="as Fig. 7", xlabel="node (the second half has 4 slots)", ylabel="MB read", yscale="log")
    axes[1][1].legend()
    measure.save(drawn, path)


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--results", type=Path, required=True)
    p.add_argument("--figures", default="4,5,6,7")
    p.add_argument("--spp", type=int, default=16)
    p.add_argument("--size", default="256x256")
    p.add_argument("--repeats", type=int, default=3)
    p.add_argument("--memory", default="84MiB", help="per node: four splits of the chest scan")
    p.add_argument("--memory-of-sizes", default="8MiB", help="per node in Fig. 6: the smallest scene fits, the largest is eight times as much")
    p.add_argument("--more", type=Path, help="a CSV of the same options, whose repeats are kept; these come after them")
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)
    bench = Bench(a)
    bench.rows = known(a.more) if a.more else []
    first = 1 + max((r["repeat"] for r in bench.rows), default=-1)
    wanted = {int(f) for f in a.figures.split(",")}
    for repeat in range(first, first + a.repeats):
        for strategy in STRATEGIES:
            if 4 in wanted:
                for frames in (1, 4):
                    bench.render(4, "chest", strategy, 8, frames, repeat)
            if 5 in wanted:
                for nodes in (2, 4, 8):
                    bench.render(5, "chest", strategy, nodes, 1, repeat)
            if 6 in wanted:
                for scene in ("head", "head-divided-1", "head-copied-2", "head-divided-2", "head-copied-4"):
                    bench.render(6, scene, strategy, 8, 1, repeat)
            if 7 in wanted:
                total = bench.render(7, "chest", strategy, 8, 1, repeat)
                if repeat == first:
                    bench.nodes.append((STRATEGIES[strategy], total["nodes_detail"]))
    name = f"{datetime.date.today()}-paper"
    with open(a.results / f"{name}.csv", "w", newline="") as f:
        w = csv.DictWriter(f, FIELDS)
        w.writeheader()
        w.writerows(bench.rows)
    plot(bench, a.results / f"{name}.svg")
    wrong = 0
    for r in bench.rows:
        if r["strategy"] != "SG with OR":
            continue
        same = [s for s in bench.rows if all(s[k] == r[k] for k in ("figure", "scene", "nodes", "frames", "repeat"))]
        passes = {s["strategy"]: s["passes"] for s in same}
        # where a node holds the scene, who reads on demand reads once, and nobody less
        fits = r["figure"] == 6 and r["scene"] == "head"
        slower = [s["strategy"] for s in same if s["modelled_s"] < r["modelled_s"]]
        if not fits and not passes["SG with OR"] <= passes["SG without OR"] <= passes["DD"]:
            wrong += 1
            print(f"fig. {r['figure']}: {r['scene']} on {r['nodes']} nodes: not the paper's order: {passes}", file=sys.stderr)
        if slower:
            print(f"fig. {r['figure']}: {r['scene']} on {r['nodes']} nodes, {r['frames']} frames: faster than SG with OR: {', '.join(slower)}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
