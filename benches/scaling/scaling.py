"""What being many costs: CPU over that of one process by stage, bytes per sample, passes and rounds, from 1 to 64 virtual nodes (of one slot, the scene in
64 splits) and from 1 to 256 splits (on 8 nodes).

Each scene is prepared once for each number of splits, as a process of its own; then one frame is rendered from what was prepared. Stages: `prepare` (that
process), `tasks` (CPU of the nodes' tasks: reading, tracing, shading, writing rays), `rest` (starting, opening the scene, planning, commits, film, picture). One
process is a run on one node that holds the whole scene as one split. `quarter` gives each node memory for a quarter of the scene, where a split fits
it. All runs of a scene must leave the same picture, or the command fails. CPU-seconds are medians of the repetitions.
"""
import argparse
import csv
import datetime
import hashlib
import json
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import measure  # noqa: E402

ISO = {"chest": "-789.5", "house": "1150.5"}
FIELDS = ["scene", "strategy", "memory", "nodes", "splits", "samples", "triangles", "scene_mb", "prepare_cpu_s", "tasks_cpu_s", "rest_cpu_s", "tax_tasks",
          "tax_rest", "tax", "bytes_per_sample", "network_per_sample", "bytes_per_hop", "hops_per_sample", "passes", "rounds", "tasks"]


def median(values: list) -> float:
    v = sorted(values)
    return 0.5 * (v[(len(v) - 1) // 2] + v[len(v) // 2])


class Bench:
    def __init__(self, a):
        self.a, self.rows, self.pictures, self.prepared = a, [], {}, {}

    def source(self, scene: str) -> list:
        """The chest scan, or a generated scene: 4 x 4 heads side by side, one whole copy after another, as a house of equal storeys would lie in its file."""
        folder = self.a.data
        if scene == "chest":
            return [folder / "ct-lidc-0314" / "dicom", "--iso", ISO["chest"]]
        ply = self.a.work / "house.ply"
        if not ply.exists():
            head = folder / "ct-headsq-quarter" / "quarter.nhdr"
            measure.run([self.a.rayherd, "scene", "replicate", head, "--iso", ISO["house"], "-o", ply, "--copies", "4,4,1", "--step", "220,220,0"])
        return [ply]

    def store(self, scene: str, splits: int) -> Path:
        """The scene prepared into so many splits, by a process of its own: its CPU is kept."""
        store = self.a.work / f"{scene}-{splits}"
        if (scene, splits) not in self.prepared:
            shutil.rmtree(store, ignore_errors=True)
            command = [self.a.rayherd, "prepare", *self.source(scene), "--splits", splits, "--size", self.a.size, "--store", store]
            self.prepared[scene, splits] = measure.run(command)[0]
        return store

    def once(self, scene: str, strategy: str, nodes: int, splits: int, memory) -> dict:
        a = self.a
        store, out, report = self.store(scene, splits), a.work / "scaling.exr", a.work / "scaling.json"
        # what was prepared is kept, the picture is made anew
        shutil.rmtree(store / "jobs", ignore_errors=True)
        command = [a.rayherd, "render", *self.source(scene), "--splits", splits, "--size", a.size, "--spp", a.spp, "--nodes", nodes, "--slots",
                   ",".join(["1"] * nodes), "--replicas", min(2, nodes), "--strategy", strategy, "--store", store, "--report", report, "-o", out]
        if memory is not None:
            command += ["--memory", memory]
        cpu, _, _ = measure.run(command)
        r = json.loads(report.read_text())
        if not r["prepare"]["reused"]:
            raise SystemExit(f"{scene} with {splits} splits was prepared again")
        digest = hashlib.sha256(out.read_bytes()).hexdigest()
        if self.pictures.setdefault(scene, digest) != digest:
            raise SystemExit(f"{scene} on {nodes} nodes with {splits} splits is another picture")
        return {**r, "process": cpu, "busy": sum(n["busy"] for n in r["nodes_detail"])}

    def measure(self, scene: str, strategy: str, nodes: int, splits: int, memory: str) -> dict:
        bytes_of = None
        if memory == "quarter":
            # the largest split, which may be half as large again as the mean one, must fit
            if splits < 8:
                return {}
            bytes_of = int(next(x["scene_mb"] for x in self.rows if x["scene"] == scene) * 1e6 / 4)
        runs = [self.once(scene, strategy, nodes, splits, bytes_of) for _ in range(self.a.repeats)]
        r = runs[0]
        moved = sum(b["bytes"] for b in r["bytes"] if b["stage"] == "trace" and b["place"] != "cache")
        samples = r["samples"]
        row = {
            "scene": scene, "strategy": strategy, "memory": memory, "nodes": nodes, "splits": splits, "samples": samples,
            "triangles": r["prepare"]["counts"]["triangles"], "scene_mb": r["scene_bytes"] / 1e6,
            "prepare_cpu_s": self.prepared[scene, splits], "tasks_cpu_s": median([x["busy"] for x in runs]),
            "rest_cpu_s": median([x["process"] - x["busy"] for x in runs]), "bytes_per_sample": moved / samples,
            "network_per_sample": r["network_bytes"] / samples, "bytes_per_hop": r["bytes_per_hop"] or "", "hops_per_sample": r["hops"] / samples,
            "passes": r["scene_passes"], "rounds": r["rounds"], "tasks": r["tasks"],
        }
        base = next((x for x in self.rows if x["scene"] == scene), row)
        one = base["tasks_cpu_s"] + base["rest_cpu_s"]
        row["tax_tasks"] = (row["tasks_cpu_s"] - base["tasks_cpu_s"]) / one
        row["tax_rest"] = (row["rest_cpu_s"] - base["rest_cpu_s"]) / one
        row["tax"] = (row["tasks_cpu_s"] + row["rest_cpu_s"]) / one
        self.rows.append(row)
        print(f"| {scene} | {strategy} | {memory} | {nodes} | {splits} | {row['prepare_cpu_s']:.1f} | {row['tasks_cpu_s']:.2f} | {row['rest_cpu_s']:.2f} | "
              f"{row['tax']:.2f} | {row['bytes_per_sample']:.1f} | {row['network_per_sample']:.1f} | {row['hops_per_sample']:.3f} | {row['passes']:.2f} | "
              f"{row['rounds']} | {row['tasks']} |", flush=True)
        return row


def plot(bench: Bench, path: Path) -> None:
    drawn, axes = measure.figure(2, 3, (16, 9))
    for column, (key, label) in enumerate((("tax", "CPU over one process"), ("bytes_per_sample", "bytes per sample, disks and network"), ("passes", "passes"))):
        for row, (x, fixed, at) in enumerate((("nodes", "splits", bench.a.fixed_splits), ("splits", "nodes", bench.a.fixed_nodes))):
            axis = axes[row][column]
            lines = {}
            for r in bench.rows:
                if r[fixed] == at and (x == "splits" or r["splits"] == at):
                    lines.setdefault(f"{r['scene']}, {r['strategy']}, {r['memory']}", {})[r[x]] = r[key]
            for name, points in sorted(lines.items()):
                axis.plot(sorted(points), [points[k] for k in sorted(points)], marker="o", label=name)
            axis.set(xlabel=f"{x} ({at} {fixed})", ylabel=label, xscale="log")
            axis.set_ylim(bottom=0)
            if lines:
                axis.legend(fontsize=7)
    measure.save(drawn, path)


def main() -> int:
    numbers = lambda text: [int(n) for n in text.split(",")]  # noqa: E731
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--results", type=Path, required=True)
    p.add_argument("--scenes", default="chest,house")
    p.add_argument("--strategies", default="auto")
    p.add_argument("--nodes", type=numbers, default=[1, 2, 4, 8, 16, 32, 64])
    p.add_argument("--splits", type=numbers, default=[1, 4, 16, 64, 256])
    p.add_argument("--fixed-nodes", type=int, default=8, help="nodes while splits vary")
    p.add_argument("--fixed-splits", type=int, default=64, help="splits while nodes vary")
    p.add_argument("--memory", default="whole,quarter")
    p.add_argument("--spp", type=int, default=16)
    p.add_argument("--size", default="128x128")
    p.add_argument("--repeats", type=int, default=3)
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)
    bench = Bench(a)
    print("| scene | strategy | memory | nodes | splits | prepare, CPU-s | tasks | rest | CPU over one process | bytes/sample | network | hops/sample | passes | rounds | tasks |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for scene in a.scenes.split(","):
        # one process first: the others are measured against it
        bench.measure(scene, "auto", 1, 1, "whole")
        done = set()
        for memory in a.memory.split(","):
            for strategy in a.strategies.split(","):
                for nodes, splits in [(n, a.fixed_splits) for n in a.nodes] + [(a.fixed_nodes, s) for s in a.splits]:
                    if (memory, strategy, nodes, splits) not in done:
                        done.add((memory, strategy, nodes, splits))
                        bench.measure(scene, strategy, nodes, splits, memory)
    name = f"{datetime.date.today()}-scaling"
    with open(a.results / f"{name}.csv", "w", newline="") as f:
        w = csv.DictWriter(f, FIELDS)
        w.writeheader()
        w.writerows(bench.rows)
    plot(bench, a.results / f"{name}.svg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
