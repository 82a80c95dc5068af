"""Renders the townhouse (10 splits, 8 virtual nodes of 2 and 4 slots, R = 2) with each strategy, one frame and several, and prints what moved.

Frames differ by their seed and share the prepared scene, whose preparation is counted once. All strategies must leave the same bytes for the same frame, or the
command fails. At the end: what overlap reduction writes more to prepare, what it reads less a frame, and so from how many frames on it pays
(the paper's Fig. 4). Prints a table to keep under results/; reports stay in the work folder.
"""
import argparse
import hashlib
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

STRATEGIES = {
    "SG with OR": "scheduling-grid-overlap-reduced",
    "auto": "auto",
    "SG without OR": "scheduling-grid",
    "DD": "demand-driven",
}
COLUMNS = ["frames", "strategy", "prepared MB", "passes", "remote", "network MB", "textures local MB", "textures remote MB", "rounds", "tasks", "hops M",
           "bytes/hop", "CPU s", "peak MiB"]


def texels(report: dict, place: str) -> int:
    """Bytes of texture tiles that tasks read from there."""
    rows = (r for r in report["bytes"] if r["stage"] != "prepare" and r["op"] == "read" and r["kind"] == "texture")
    return sum(r["bytes"] for r in rows if r["place"] == place)


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--scene", required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--size", default="256x256")
    p.add_argument("--spp", type=int, default=64)
    p.add_argument("--frames", type=int, default=5)
    p.add_argument("--splits", default="10")
    p.add_argument("--memory", default="64MiB", help="per node: a slot of the smaller nodes may hold several of the ten splits")
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)
    print("| " + " | ".join(COLUMNS) + " |")
    print("|" + "---|" * len(COLUMNS))
    sums: dict[int, str] = {}
    of: dict[str, list] = {name: [] for name in STRATEGIES}
    for name, strategy in STRATEGIES.items():
        store = a.work / f"store-{strategy}"
        shutil.rmtree(store, ignore_errors=True)
        prepared = 0
        for frame in range(a.frames):
            # each frame is a job of its own; the prepared scene stays
            shutil.rmtree(store / "jobs", ignore_errors=True)
            out, path = a.work / f"{strategy}-{frame}.exr", a.work / f"{strategy}-{frame}.json"
            command = [a.rayherd, "render", a.scene, "--splits", a.splits, "--size", a.size, "--spp", str(a.spp), "--seed", str(frame),
                       "--nodes", "8", "--slots", "2,2,2,2,4,4,4,4", "--replicas", "2", "--memory", a.memory, "--strategy", strategy,
                       "--store", str(store), "--report", str(path), "-o", str(out)]
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            if done.returncode:
                print(done.stderr, file=sys.stderr)
                return 1
            digest = hashlib.sha256(out.read_bytes()).hexdigest()
            if sums.setdefault(frame, digest) != digest:
                print(f"frame {frame} by {name} is another file", file=sys.stderr)
                return 1
            report = json.loads(path.read_text())
            if not report["prepare"]["reused"]:
                prepared = sum(row["bytes"] for row in report["prepare"]["took"]["bytes"])
            of[name].append(report)
            if frame + 1 in (1, a.frames):
                tell(frame + 1, name, prepared, of[name])
        of[name].append(prepared)
    print(f"\nsha256 of frame 0 by every strategy: {sums[0][:16]}")
    plain, reduced = of["SG without OR"], of["SG with OR"]
    extra = reduced[-1] - plain[-1]
    saved, network = ((sum(map(of_frame, plain[:-1])) - sum(map(of_frame, reduced[:-1]))) / a.frames for of_frame in (moved, lambda r: r["network_bytes"]))
    pays = f"it pays from {max(1, math.ceil(extra / saved))} frame(s) on" if saved > 0 else "it never pays here"
    print(f"overlap reduction moves {extra / 1e6:,.1f} MB more to prepare, on disks and between nodes, and {saved / 1e6:,.1f} MB less a frame, "
          f"{network / 1e6:,.1f} MB of them between nodes: in bytes {pays}")
    return 0


def moved(report: dict) -> int:
    """Bytes that a frame's tasks read and wrote, on disks and between nodes."""
    return sum(r["bytes"] for r in report["bytes"] if r["stage"] != "prepare" and r["place"] in ("local", "remote"))


def tell(frames: int, name: str, prepared: int, reports: list) -> None:
    """A row: sums over the frames; ratios of the sums."""
    total = {key: sum(r[key] for r in reports) for key in ("network_bytes", "scene_passes", "rounds", "tasks", "hops", "cpu_s")}
    remote = sum(r["remote_ratio"] * r["scene_passes"] for r in reports) / total["scene_passes"] if total["scene_passes"] else 0.0
    local, far = (sum(texels(r, place) for r in reports) for place in ("local", "remote"))
    hops = sum((r["bytes_per_hop"] or 0) * r["hops"] for r in reports)
    per_hop = f"{hops / total['hops']:.1f}" if total["hops"] else ""
    print(f"| {frames} | {name} | {prepared / 1e6:,.0f} | {total['scene_passes']:.2f} | {remote:.3f} | {total['network_bytes'] / 1e6:,.0f} | {local / 1e6:,.1f} | "
          f"{far / 1e6:,.1f} | {total['rounds']} | {total['tasks']} | {total['hops'] / 1e6:.2f} | {per_hop} | {total['cpu_s']:.1f} | "
          f"{max(r['peak_memory_bytes'] for r in reports) / 2**20:.0f} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
