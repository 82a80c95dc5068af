"""Renders a scene with a skip and without it, and prints what was counted: rows for the table of docs/skips.md.

Counts do not depend on the machine; CPU-seconds do and are printed beside them. Exits with 1 when a picture that must be the same is another.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

ONE_SPLIT_A_TASK = ["--splits", "32", "--nodes", "8", "--slots", "1", "--strategy", "scheduling-grid-overlap-reduced"]
CHEST = ["CHEST", "--iso", "-789.5", "--size", "128x128", "--spp", "1"]
CORNELL = ["CORNELL", "--size", "256x256", "--spp", "16"]
STAIRCASE = ["STAIRCASE", "--size", "256x256", "--spp", "4"]

# skip, scene and flags, what it saves: keys of the report, or bytes by stage, direction and kind
ROWS = [
    ("cells", CHEST + ONE_SPLIT_A_TASK, ["hops", "trace:write:rays"]),
    ("beaten", CHEST + ONE_SPLIT_A_TASK, ["hops", "trace:write:rays"]),
    ("splits", CHEST + ONE_SPLIT_A_TASK, ["trace:read:geometry"]),
    ("attributes", CHEST + ONE_SPLIT_A_TASK + ["--memory", "32Mi"], ["trace:read:attributes"]),
    ("film", CHEST + ONE_SPLIT_A_TASK, ["trace:write:film"]),
    ("volume", CHEST, ["cpu_s"]),
    ("prepared", CHEST + ["--store", "STORE", "--resume"], ["prepare:read:source", "prepare:write:geometry", "cpu_s"]),
    ("walk", CHEST, ["cpu_s"]),
    ("sky", CORNELL, ["cpu_s"]),
    ("textures", STAIRCASE, ["trace:read:texture"]),
    ("aovs", CORNELL, ["cpu_s"]),
    ("lobes", STAIRCASE, ["cpu_s"]),
    ("details", STAIRCASE, ["cpu_s"]),
    ("shadows", CORNELL, ["rays.shadow"]),
    ("merged", CORNELL + ["--split", "4"], ["rays.closest"]),
    ("roulette", CORNELL, ["rays.closest", "rays.shadow", "rel_mse"]),
    ("tiles", ["VEACH-MIS", "--size", "256x256", "--spp", "4096", "--target-error", "0.0005"], ["samples", "cpu_s", "rel_mse"]),
    ("lights", ["LAMPS", "--size", "128x128", "--spp", "16"], ["rays.shadow", "rel_mse"]),
]
SAME_MEAN = {"roulette", "lights", "tiles"}


def value(report, key):
    if ":" in key:
        stage, op, kind = key.split(":")
        rows = [r for r in report["bytes"] if (r["stage"], r["op"], r["kind"]) == (stage, op, kind) and r["place"] != "cache"]
        return sum(r["bytes"] for r in rows)
    for part in key.split("."):
        report = report[part]
    return report


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rayherd", required=True)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--examples", required=True, type=pathlib.Path)
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    only = set(filter(None, arguments.only.split(",")))
    if unknown := only - {row[0] for row in ROWS}:
        sys.exit(f"no row for {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as work:
        work = pathlib.Path(work)
        names = {
            "CHEST": arguments.data / "ct-lidc-0314" / "dicom",
            "CORNELL": arguments.examples / "cornell-box.xml",
            "STAIRCASE": next((arguments.data / "scene-staircase").glob("**/*.xml")),
            "VEACH-MIS": next((arguments.data / "scene-veach-mis").glob("**/*.xml")),
            "LAMPS": work / "lamps.xml",
            "STORE": work / "store",
        }
        subprocess.run([arguments.rayherd, "scene", "many-lights", "1000", "-o", names["LAMPS"]], check=True, capture_output=True)

        def render(flags, more):
            flags = [str(names.get(f, f)) for f in flags]
            command = [arguments.rayherd, "render", *flags, *more, "-o", work / "x.exr", "--report", work / "r.json"]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode != 0:
                sys.exit(f"{command}: {done.stderr}")
            return (work / "x.exr").read_bytes(), json.loads((work / "r.json").read_text())

        failed = False
        for skip, flags, keys in ROWS:
            if only and skip not in only:
                continue
            if "--store" in flags:
                render([f for f in flags if f != "--resume"], [])
            (image, usual), (other, without) = render(flags, []), render(flags, ["--no-skip", skip])
            same = image == other
            failed |= not same and skip not in SAME_MEAN
            found = [f"{key} {value(usual, key):.6g}, without {value(without, key):.6g}" for key in keys]
            print(f"{skip}: {usual['skips'][skip]} skipped ({' '.join(flags)}): {'; '.join(found)}; {'same bytes' if same else 'another picture'}", flush=True)
        sys.exit(failed)


if __name__ == "__main__":
    main()
