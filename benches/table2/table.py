"""Renders the chest scan (-789.5, 32 splits, 8 virtual nodes of 2 and 4 slots, R = 2, 256 x 256) with each strategy and prints what moved.

Memory per node is that of two splits per slot of the smaller nodes (`--memory`), or a quarter of the scene (`auto-quarter`). One file per number
of samples: all strategies must leave the same bytes, or the command fails. Prints a table to keep under results/; reports stay in the work folder.
"""
import argparse
import hashlib
import json
import subprocess
import sys
from pathlib import Path

STRATEGIES = {
    "sg-or": ("scheduling-grid-overlap-reduced", "memory"),
    "auto": ("auto", "memory"),
    "auto-quarter": ("auto", "quarter"),
    "sg": ("scheduling-grid", "memory"),
    "dd": ("demand-driven", "memory"),
}
# Table II, tracing: 5,000 samples of 1024 x 1024; passes, remote ratio (rays and film included), remote MB
PAPER = [("SG with OR", 42.4, 0.49, 83_825), ("SG without OR", 62.8, 0.62, 157_306), ("DD", 64.8, 0.76, 198_932)]


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--scan", required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--spp", default="16,64,256")
    p.add_argument("--only", default=",".join(STRATEGIES))
    p.add_argument("--memory", default="84MiB", help="per node: four splits of this scan")
    p.add_argument("--quarter", default="106MiB", help="per node: a quarter of this scan")
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)
    print("| spp | strategy | passes | remote | with rays and film | network MB | rounds | tasks | hops M | bytes/hop | CPU s | peak MiB |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    differs = 0
    for spp in a.spp.split(","):
        sums = set()
        for name in a.only.split(","):
            strategy, memory = STRATEGIES[name]
            out, report = a.work / f"{name}-{spp}.exr", a.work / f"{name}-{spp}.json"
            command = [a.rayherd, "render", a.scan, "--iso", "-789.5", "--splits", "32", "--size", "256x256", "--nodes", "8",
                       "--slots", "2,2,2,2,4,4,4,4", "--replicas", "2", "--spp", spp, "--strategy", strategy,
                       "--memory", getattr(a, memory), "--report", str(report), "-o", str(out)]
            done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            if done.returncode:
                print(done.stderr, file=sys.stderr)
                return 1
            sums.add(hashlib.sha256(out.read_bytes()).hexdigest())
            r = json.loads(report.read_text())
            hop = "" if r["bytes_per_hop"] is None else f"{r['bytes_per_hop']:.1f}"
            print(f"| {spp} | {name} | {r['scene_passes']:.2f} | {r['remote_ratio']:.3f} | {r['remote_ratio_all']:.3f} | "
                  f"{r['network_bytes'] / 1e6:,.0f} | {r['rounds']} | {r['tasks']} | {r['hops'] / 1e6:.2f} | {hop} | {r['cpu_s']:.1f} | "
                  f"{r['peak_memory_bytes'] / 2**20:.0f} |", flush=True)
        if len(sums) != 1:
            differs = 1
            print(f"the strategies leave {len(sums)} different files at {spp} samples", file=sys.stderr)
        else:
            print(f"| {spp} | sha256 of all | {sums.pop()[:16]} | | | | | | | | | |", flush=True)
    for name, passes, ratio, mb in PAPER:
        print(f"| paper | {name} | {passes} | | {ratio} | {mb:,} | | | | | | |")
    return differs


if __name__ == "__main__":
    sys.exit(main())
