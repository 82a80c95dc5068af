"""Makes the pictures of small scenes that `cli/tests/oracles.rs` compares with: Mitsuba 3's, one scene for each material, emitter, sensor, shape and feature.

Each is the mean of enough samples that its own noise is far below that of the test's renders.
"""
import argparse
import shutil
from pathlib import Path

import numpy as np

import features
import scenes

SIZE, MAX_DEPTH = 24, 8
SPP, RENDERS = 4096, 8


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", default=[*scenes.MATERIALS, *scenes.EMITTERS, *features.ORACLES])
    p.add_argument("--rayherd", required=True, help="makes those scenes that `rayherd scene` makes")
    p.add_argument("--shared", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    a = p.parse_args()
    out = Path(__file__).resolve().parents[2] / "cli/tests/oracles"
    out.mkdir(exist_ok=True)
    a.work.mkdir(parents=True, exist_ok=True)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for name in a.names:
        xml = scenes.prepare(name, a.shared.resolve(), a.work.resolve(), a.rayherd, SIZE)
        scene = mi.load_file(str(scenes.read_by_mitsuba(xml)), **scenes.parameters(xml, SIZE, MAX_DEPTH))
        images = np.array([np.array(mi.render(scene, spp=SPP, seed=500 + i), dtype=np.float64)[..., :3] for i in range(RENDERS)])
        shutil.copy(xml, out / f"{name}.xml")
        mi.Bitmap(images.mean(0).astype(np.float32)).write(str(out / f"{name}.exr"))
        means = images.mean((1, 2, 3))
        print(f"{name}: mean {means.mean():.5f}, its standard error {means.std(ddof=1) / len(means) ** 0.5 / means.mean():.3%}", flush=True)
    for picture in ["sky.hdr", "slide.hdr", "sheet.ply", *features.FILES]:
        if (a.work / picture).exists():
            shutil.copy(a.work / picture, out / picture)


if __name__ == "__main__":
    main()
