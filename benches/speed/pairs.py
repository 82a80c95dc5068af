"""Median of the CPU ratio rayherd / Mitsuba over interleaved pairs, with its 95 % interval (order statistics)."""
import argparse
import csv
import datetime
import platform
import sys
from pathlib import Path

import numpy as np

import scenes
from measure import interval, run

SPP = {"cornell": 1024, "gyroid": 256, "veach-mis": 256, "staircase": 128, "living-room": 128, "classroom": 128}

MITSUBA = """
import sys, mitsuba as mi
mi.set_variant('llvm_ad_rgb')
import drjit as dr
xml, spp, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
max_depth, rr_depth = map(int, sys.argv[4].split(','))
scene = mi.load_file(xml, **dict(kv.split('=') for kv in sys.argv[5:]))
integrator = mi.load_dict({'type': 'path', 'max_depth': max_depth, 'rr_depth': rr_depth}) if rr_depth else None
dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=seed))
dr.sync_thread()
"""


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", default=["cornell", "gyroid"])
    p.add_argument("--rayherd", required=True)
    p.add_argument("--shared", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--results", type=Path, required=True)
    p.add_argument("--pairs", type=int, default=10)
    p.add_argument("--size", type=int, default=256)
    p.add_argument("--max-depth", type=int, default=8)
    p.add_argument("--rr-depth", type=int, default=0, help="from which ray on Mitsuba's roulette ends paths, instead of from the fifth or what the scene says")
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)
    # now, not after an hour of measuring
    a.results.mkdir(parents=True, exist_ok=True)
    machine = next((l.split(":")[1].strip() for l in open("/proc/cpuinfo") if l.startswith("model name")), platform.machine())
    out = a.results / f"{datetime.date.today()}-{machine.replace(' ', '-')}-speed.csv"
    rows = []
    for name in a.names:
        xml = scenes.prepare(name, a.shared.resolve(), a.work.resolve())
        values = scenes.parameters(xml, a.size, a.max_depth)
        spp = SPP[name]
        ours = [a.rayherd, "render", str(xml), "--size", f"{a.size}x{a.size}", "--spp", str(spp), "--max-depth", str(a.max_depth),
                "-o", str(a.work / "bench.exr")]
        theirs = [sys.executable, "-c", MITSUBA, str(scenes.read_by_mitsuba(xml)), str(spp), "1", f"{a.max_depth},{a.rr_depth}"]
        theirs += [f"{k}={v}" for k, v in values.items()]
        run(theirs)  # fills Mitsuba's kernel cache
        for i in range(a.pairs):
            (co, wo, _), (ct, wt, _) = run(ours), run(theirs)
            rows.append([name, spp, i, co, wo, ct, wt, co / ct])
            print(f"{name} pair {i}: rayherd {co:.2f} CPU-s, mitsuba {ct:.2f} CPU-s, ratio {co / ct:.3f}", flush=True)
        ratios = [r[7] for r in rows if r[0] == name]
        lo, hi = interval(ratios)
        print(f"{name} {spp} spp: median ratio {np.median(ratios):.3f}, 95 % interval {lo:.3f} to {hi:.3f}", flush=True)
    # another run of the same day adds to it
    with open(out, "a", newline="") as f:
        w = csv.writer(f)
        if f.tell() == 0:
            w.writerow(["scene", "spp", "pair", "rayherd_cpu_s", "rayherd_wall_s", "mitsuba_cpu_s", "mitsuba_wall_s", "cpu_ratio"])
        w.writerows(rows)
    print(f"written to {out}")


if __name__ == "__main__":
    main()
