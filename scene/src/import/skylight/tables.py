"""Makes tables.bin from the data files of Mitsuba's `sunsky` (its folder data/sunsky): little-endian f32, one array after the other.

    sky_params  turbidity 1 to 10, albedo 0 and 1, 6 control points, R G B, 9 parameters
    sky_rad     turbidity 1 to 10, albedo 0 and 1, 6 control points, R G B
    sun         turbidity 1 to 10, elevation 2, 5, .. 89 degrees, R G B: irradiance as Mitsuba weighs its 11 wavelengths

    python tables.py MITSUBA/data/sunsky tables.bin
"""
import struct
import sys
from pathlib import Path

import numpy as np

# CIE 1931 x, y, z at 320, 360 .. 720 nm, and XYZ to linear Rec. 709
XYZ = np.array([
    [0, 0, 0], [1.299e-4, 3.917e-6, 6.061e-4], [0.01431, 3.96e-4, 0.06785001], [0.34828, 0.023, 1.74706],
    [0.09564, 0.13902, 0.8129501], [0.06327, 0.71, 0.07824999], [0.5945, 0.995, 0.0039], [1.0622, 0.631, 8e-4],
    [0.4479, 0.175, 2e-5], [0.04677, 0.017, 0], [0.002899327, 0.001047, 0]])
RGB = np.array([[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]])
CIE_Y = 106.7502593994140625  # integral of y


def fields(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a file of Mitsuba's tensor format."""
    data = path.read_bytes()
    count, at = struct.unpack("<I", data[14:18])[0], 18
    out = {}
    for _ in range(count):
        length = struct.unpack_from("<H", data, at)[0]
        name = data[at + 2:at + 2 + length].decode()
        at += 2 + length
        dims, kind, offset = struct.unpack_from("<HBQ", data, at)
        shape = struct.unpack_from(f"<{dims}Q", data, at + 11)
        at += 11 + 8 * dims
        kind = {10: "<f4", 11: "<f8"}[kind]
        out[name] = np.frombuffer(data, kind, int(np.prod(shape)), offset).reshape(shape).astype(np.float64)
    return out


def main() -> None:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    sky, sun = fields(folder / "sunsky_datasets.bin"), fields(folder / "sampling_data.bin")
    rgb = sun["sun_irradiance"] @ (XYZ @ RGB.T) / (11 * CIE_Y)
    arrays = [sky["sky_params_rgb"], sky["sky_rad_rgb"], rgb]
    out.write_bytes(b"".join(a.astype("<f4").tobytes() for a in arrays))


if __name__ == "__main__":
    main()
