"""Compares the mean of independent renders with Mitsuba's, per channel and per tile.

Passes when, for each channel, three standard errors are below 0.5 % of the mean and the difference of the means is within
three standard errors + 0.1 %, and in no channel more than 3 of 256 tiles lie beyond four standard errors (bitmap-jpeg: scenes.TILES), but for rows of
tiles that are known to (scenes.ROWS).
"""
import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

import features
import scenes


def tiles(image: np.ndarray, n: int = 16) -> np.ndarray:
    """Means of n x n tiles, shape (n, n, 3)."""
    h, w, _ = image.shape
    return image.reshape(n, h // n, n, w // n, 3).mean((1, 3))


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", default=scenes.NAMES)
    p.add_argument("--rayherd", required=True)
    p.add_argument("--shared", type=Path, required=True)
    p.add_argument("--work", type=Path, required=True)
    p.add_argument("--size", type=int, default=128)
    p.add_argument("--spp", type=int, help="of one render; by default what the scene needs, 256 for most")
    p.add_argument("--renders", type=int, help="by default what the scene needs, 16 for most")
    p.add_argument("--max-depth", type=int, default=8)
    p.add_argument("--quick", action="store_true", help="fewer samples: finds gross errors only")
    a = p.parse_args()
    a.work.mkdir(parents=True, exist_ok=True)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    failed = 0
    print(f"{'scene':20} {'ch':2} {'rayherd':>10} {'mitsuba':>10} {'difference':>10} {'3 s.e.':>8}  tiles > 4 s.e.  verdict")
    groups = {"materials": scenes.MATERIALS, "emitters": scenes.EMITTERS, "features": features.FEATURES}
    names = [n for name in a.names for n in groups.get(name, [name])]
    for name in names:
        xml = scenes.prepare(name, a.shared.resolve(), a.work.resolve(), a.rayherd, a.size)
        scene = mi.load_file(str(scenes.read_by_mitsuba(xml)), **scenes.parameters(xml, a.size, a.max_depth))
        spp, renders = (64, 8) if a.quick else scenes.ENOUGH.get(name, (256, 16))
        spp, renders = a.spp or spp, a.renders or renders
        theirs, ours = [], []
        for i in range(renders):
            theirs.append(np.array(mi.render(scene, spp=spp, seed=1000 + i), dtype=np.float64)[..., :3])
            out = a.work / f"{name}-{i}.exr"
            command = [a.rayherd, "render", str(xml), "--size", f"{a.size}x{a.size}", "--spp", str(spp), "--seed", str(i),
                       "--max-depth", str(a.max_depth), "-o", str(out)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            image = np.array(mi.Bitmap(str(out)), dtype=np.float64)[..., :3]
            ours.append(image)
            os.remove(out)
        theirs, ours = np.array(theirs), np.array(ours)
        np.save(a.work / f"{name}-rayherd.npy", ours.mean(0))
        np.save(a.work / f"{name}-mitsuba.npy", theirs.mean(0))
        write_difference(mi, ours.mean(0), theirs.mean(0), a.work / f"{name}-difference.png")
        to, tt = np.array([tiles(x) for x in ours]), np.array([tiles(x) for x in theirs])
        tile_error = np.sqrt(to.var(0, ddof=1) / len(to) + tt.var(0, ddof=1) / len(tt))
        # tiles of nothing but sky have no noise; Mitsuba sums a pixel's samples in f32, each of which may round by 2^-24 of the sum
        rounding = spp * 2**-24 * tt.mean(0)
        beyond = np.abs(to.mean(0) - tt.mean(0)) > 4 * tile_error + rounding
        elsewhere = np.delete(beyond, sorted(scenes.ROWS.get(name, ())), axis=0).sum((0, 1))
        for c in range(3):
            mo, mt = ours[..., c].mean((1, 2)), theirs[..., c].mean((1, 2))
            error = 3 * np.sqrt(mo.var(ddof=1) / len(mo) + mt.var(ddof=1) / len(mt)) / mt.mean()
            difference = mo.mean() / mt.mean() - 1
            good = error < 0.005 and abs(difference) <= error + 0.001 and elsewhere[c] <= scenes.TILES.get(name, 3)
            failed += not good
            print(f"{name:20} {'RGB'[c]:2} {mo.mean():10.6f} {mt.mean():10.6f} {difference:+10.4%} {error:8.4%}"
                  f"  {beyond[..., c].sum():3} of 256      {'agrees' if good else 'DIFFERS'}", flush=True)
            if beyond[..., c].any():
                where = " ".join(f"{row},{column}" for row, column in zip(*np.nonzero(beyond[..., c])))
                print(f"    rows,columns of tiles: {where}", flush=True)
    print(f"{3 * len(names) - failed} passed, {failed} failed")
    return 1 if failed else 0


def write_difference(mi, ours: np.ndarray, theirs: np.ndarray, path: Path) -> None:
    """Red where ours is brighter, blue where darker; full scale is 20 % of the local mean."""
    d = ((ours - theirs).mean(-1) / (theirs.mean(-1) + 0.01)) / 0.2
    rgb = np.stack([np.clip(d, 0, 1), np.zeros_like(d), np.clip(-d, 0, 1)], -1)
    mi.Bitmap(rgb.astype(np.float32)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(str(path))


if __name__ == "__main__":
    sys.exit(main())
