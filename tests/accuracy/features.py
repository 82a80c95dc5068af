"""Small scenes of what materials, shapes, films and integrators have beside their kind: textures and how they are looked up, masks, reliefs, both sides,
anisotropy, meshes of each format, filters, crops. Each is a ball and a tilted plate of one material, or the floor with things on it, of `scenes`."""
import struct
import zlib
from pathlib import Path

import numpy as np

import scenes


def bitmap(name: str, file: str, **options: str) -> str:
    """A texture for a parameter; options `raw`, `filter_type`, `wrap_mode`, `to_uv` (what stands in the transform)."""
    raw = f'<boolean name="raw" value="{options["raw"]}"/>' if "raw" in options else ""
    words = "".join(f'<string name="{k}" value="{options[k]}"/>' for k in ("filter_type", "wrap_mode") if k in options)
    to_uv = f'<transform name="to_uv">{options["to_uv"]}</transform>' if "to_uv" in options else ""
    return f'<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/>{raw}{words}{to_uv}</texture>'


def diffuse(texture: str) -> str:
    return f'<bsdf type="diffuse">{texture}</bsdf>'


def two(*inside: str) -> str:
    return f'<bsdf type="twosided">{"".join(inside)}</bsdf>'


RED = diffuse('<rgb name="reflectance" value="0.8, 0.3, 0.2"/>')
BLUE = diffuse('<rgb name="reflectance" value="0.2, 0.3, 0.8"/>')
# GGX: Mitsuba's masking of Beckmann's is a fit, up to 0.35 % off
COPPER = ('<bsdf type="roughconductor"><string name="material" value="Cu"/><string name="distribution" value="ggx"/><float name="alpha" value="0.3"/>'
          '</bsdf>')
SPREAD = '<scale x="2.5" y="1.5"/><translate x="-0.6" y="-0.2"/>'
PAINT = "paint.png"

# a ball and a plate of these
MATERIALS = {
    "mask": f'<bsdf type="mask"><float name="opacity" value="0.4"/>{two(RED)}</bsdf>',
    "mask-texture": f'<bsdf type="mask">{bitmap("opacity", "grey.png", raw="true")}{two(RED)}</bsdf>',
    "bumpmap": two(f'<bsdf type="bumpmap">{bitmap("map", "hills.png", raw="true")}<float name="scale" value="0.15"/>{RED}</bsdf>'),
    "normalmap": two(f'<bsdf type="normalmap">{bitmap("normalmap", "normals.png", raw="true")}{COPPER}</bsdf>'),
    "null": '<bsdf type="null"/>',
    "bitmap": diffuse(bitmap("reflectance", PAINT)),
    "bitmap-raw": diffuse(bitmap("reflectance", PAINT, raw="true")),
    "bitmap-jpeg": diffuse(bitmap("reflectance", "paint.jpg")),
    "bitmap-exr": diffuse(bitmap("reflectance", "paint.exr")),
    "bitmap-repeat-nearest": diffuse(bitmap("reflectance", PAINT, filter_type="nearest", wrap_mode="repeat", to_uv=SPREAD)),
    "bitmap-mirror-bilinear": diffuse(bitmap("reflectance", PAINT, wrap_mode="mirror", to_uv=SPREAD)),
    "bitmap-mirror-nearest": diffuse(bitmap("reflectance", PAINT, filter_type="nearest", wrap_mode="mirror", to_uv=SPREAD)),
    "bitmap-clamp-bilinear": diffuse(bitmap("reflectance", PAINT, wrap_mode="clamp", to_uv=SPREAD)),
    "bitmap-clamp-nearest": diffuse(bitmap("reflectance", PAINT, filter_type="nearest", wrap_mode="clamp", to_uv=SPREAD)),
    "bitmap-turned": diffuse(bitmap("reflectance", PAINT, to_uv='<rotate z="1" angle="30"/><scale value="2"/>')),
    "checkerboard": diffuse('<texture type="checkerboard" name="reflectance"><rgb name="color0" value="0.8, 0.6, 0.1"/><rgb name="color1" '
                            'value="0.1, 0.2, 0.5"/><transform name="to_uv"><rotate z="1" angle="20"/><scale x="6" y="4"/></transform></texture>'),
    "alpha-texture": f'<bsdf type="roughconductor"><string name="material" value="Cu"/>{bitmap("alpha", "grey.png", raw="true")}</bsdf>',
    "weight-texture": f'<bsdf type="blendbsdf">{bitmap("weight", "grey.png", raw="true")}{RED}{COPPER}</bsdf>',
    "roughness-texture": f'<bsdf type="principled">{bitmap("base_color", PAINT)}{bitmap("roughness", "grey.png", raw="true")}'
                         '<float name="metallic" value="0.5"/></bsdf>',
    "specular-texture": f'<bsdf type="roughplastic">{bitmap("diffuse_reflectance", PAINT)}{bitmap("specular_reflectance", "grey.png", raw="true")}'
                        '<float name="alpha" value="0.2"/></bsdf>',
    "anisotropic-conductor": '<bsdf type="roughconductor"><string name="material" value="Al"/><float name="alpha_u" value="0.1"/>'
                             '<float name="alpha_v" value="0.4"/></bsdf>',
    "anisotropic-conductor-ggx": '<bsdf type="roughconductor"><string name="material" value="Al"/><string name="distribution" value="ggx"/>'
                                 '<float name="alpha_u" value="0.4"/><float name="alpha_v" value="0.1"/></bsdf>',
    "anisotropic-dielectric": '<bsdf type="roughdielectric"><string name="distribution" value="ggx"/><float name="alpha_u" value="0.1"/>'
                              '<float name="alpha_v" value="0.35"/></bsdf>',
    "anisotropic-principled": '<bsdf type="principled"><rgb name="base_color" value="0.7, 0.5, 0.2"/><float name="roughness" value="0.4"/>'
                              '<float name="anisotropic" value="0.8"/><float name="metallic" value="0.9"/></bsdf>',
    "principled-lobes": '<bsdf type="principled"><rgb name="base_color" value="0.7, 0.3, 0.4"/><float name="roughness" value="0.6"/>'
                        '<float name="flatness" value="0.7"/><float name="spec_tint" value="0.8"/><float name="sheen" value="0.9"/>'
                        '<float name="sheen_tint" value="0.7"/><float name="clearcoat" value="0.5"/><float name="clearcoat_gloss" value="0.3"/>'
                        '<float name="specular" value="0.8"/></bsdf>',
}

GREEN = two(diffuse('<rgb name="reflectance" value="0.2, 0.6, 0.3"/>'))


def mesh(kind: str, more: str = "", bsdf: str = two(diffuse(bitmap("reflectance", PAINT)))) -> str:
    """A curved sheet from a file, over the floor."""
    return (f'<shape type="{kind}"><string name="filename" value="wave.{kind}"/>{more}<transform name="to_world"><rotate x="1" angle="-40"/>'
            f'<translate x="-0.3" y="1.3" z="0.6"/></transform>{bsdf}</shape>')


BALL_LAMP = ('<shape type="sphere"><point name="center" x="0.3" y="2.2" z="0"/><float name="radius" value="0.3"/>'
             '<emitter type="area"><rgb name="radiance" value="9, 8, 6"/></emitter></shape>')
FOV = scenes.FOV
# emitter and shapes beside those of scenes.LIT; what the sensor has; what the film has in the place of its box; what the integrator has
OTHERS = {
    "constant": ('<emitter type="constant"><rgb name="radiance" value="0.9, 0.6, 0.4"/></emitter>', FOV, "", ""),
    "obj": (scenes.DISK + mesh("obj"), FOV, "", ""),
    "serialized": (scenes.DISK + mesh("serialized"), FOV, "", ""),
    "face-normals": (scenes.DISK + mesh("obj", '<boolean name="face_normals" value="true"/>'), FOV, "", ""),
    "flip-normals": (scenes.DISK + mesh("obj", '<boolean name="flip_normals" value="true"/>', two(RED, BLUE))
                     + '<shape type="sphere"><point name="center" x="1.3" y="1.6" z="0.3"/><float name="radius" value="0.3"/>'
                     f'<boolean name="flip_normals" value="true"/>{two(RED, BLUE)}</shape>', FOV, "", ""),
    "two-materials": (scenes.DISK + mesh("obj", "", two(RED, COPPER)) + mesh("obj", "", two(COPPER, BLUE)).replace('angle="-40"', 'angle="140"')
                      .replace('x="-0.3"', 'x="1.2"'), FOV, "", ""),
    "tent": (scenes.DISK, FOV, '<rfilter type="tent"/><boolean name="sample_border" value="true"/>', ""),
    "gaussian": (scenes.DISK, FOV, '<rfilter type="gaussian"/><boolean name="sample_border" value="true"/>', ""),
    "crop": (scenes.DISK, FOV, "CROP", ""),
    "fov-diagonal": (scenes.DISK, '<float name="fov" value="50"/><string name="fov_axis" value="diagonal"/>', "", ""),
    "focal-length": (scenes.DISK, '<string name="focal_length" value="60mm"/>', "", ""),
    "hide-emitters": (scenes.ENVMAP + BALL_LAMP, FOV, "", '<boolean name="hide_emitters" value="true"/>'),
    "rr-depth": (scenes.DISK, FOV, "", '<integer name="rr_depth" value="2"/>'),
}

FEATURES = [*MATERIALS, *OTHERS]
# those whose pictures `cargo test` compares with: what the others have beside these is tested by values
ORACLES = [
    "mask", "mask-texture", "bumpmap", "normalmap", "bitmap", "bitmap-raw", "bitmap-jpeg", "bitmap-exr", "bitmap-repeat-nearest", "bitmap-mirror-bilinear",
    "bitmap-clamp-nearest", "bitmap-turned", "checkerboard", "alpha-texture", "weight-texture", "roughness-texture", "anisotropic-conductor-ggx",
    "anisotropic-dielectric", "anisotropic-principled", "principled-lobes", "constant", "obj", "serialized", "flip-normals", "two-materials", "gaussian",
    "crop", "focal-length", "hide-emitters", "rr-depth",
]


def text(name: str, size: int) -> str:
    """The scene, for pictures of `size` x `size` pixels."""
    if name in MATERIALS:
        return scenes.SMALL.replace("MATERIAL", MATERIALS[name])
    beside, lens, film, integrator = OTHERS[name]
    out = scenes.LIT.replace("SENSOR", "perspective").replace("LENS", lens).replace("EMITTER", beside).replace('<scale x="2" y="2"/>', "")
    out = out.replace("</integrator>", integrator + "</integrator>")
    if film == "CROP":
        # twice as large as the picture, which lies off its middle
        whole = "".join(f'<integer name="{side}" value="{2 * size}"/>' for side in ("width", "height"))
        part = "".join(f'<integer name="crop_{k}" value="{v}"/>' for k, v in
                       [("width", size), ("height", size), ("offset_x", size // 3), ("offset_y", 2 * size // 3)])
        return out.replace('<integer name="width" value="$res"/><integer name="height" value="$res"/>', whole + part)
    return out.replace('<rfilter type="box"/>', film) if film else out


def write_files(folder: Path) -> None:
    """The pictures and meshes that these scenes name."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")
    y, x = np.mgrid[0:16, 0:16] / 16
    smooth = np.stack([0.5 + 0.45 * np.sin(2 * np.pi * x), 0.2 + 0.7 * y, 0.5 + 0.4 * np.cos(2 * np.pi * (x + y))], -1)
    patches = np.array([[[(i * 37 + j * 91) % 256, (i * 11 + j * 57 + 80) % 256, (i * 73 + j * 23 + 160) % 256] for i in range(12)]
                        for j in range(8)], dtype=np.uint8)
    mi.Bitmap(patches).write(str(folder / PAINT))
    mi.Bitmap((smooth * 255).astype(np.uint8)).write(str(folder / "paint.jpg"), quality=95)
    mi.Bitmap(smooth.astype(np.float32)).write(str(folder / "paint.exr"))
    grey = np.array([[(i * 61 + j * 97) % 230 + 20 for i in range(6)] for j in range(5)], dtype=np.uint8)[..., None]
    mi.Bitmap(grey).write(str(folder / "grey.png"))
    y, x = np.mgrid[0:32, 0:32] / 32
    heights = 0.5 + 0.25 * np.sin(4 * np.pi * x) * np.cos(4 * np.pi * y)
    mi.Bitmap((heights * 255).round().astype(np.uint8)[..., None]).write(str(folder / "hills.png"))
    slope = [-0.3 * np.cos(4 * np.pi * x) * np.cos(4 * np.pi * y), 0.3 * np.sin(4 * np.pi * x) * np.sin(4 * np.pi * y), np.ones_like(x)]
    normal = np.stack(slope, -1) / np.linalg.norm(np.stack(slope, -1), axis=-1, keepdims=True)
    mi.Bitmap(((normal * 0.5 + 0.5) * 255).round().astype(np.uint8)).write(str(folder / "normals.png"))

    # a sheet of 8 x 8 quads, two units wide, curved, with normals and texture coordinates
    n = 9
    t, s = np.divide(np.mgrid[0:n, 0:n], n - 1)
    points = np.stack([2 * s - 1, 2 * t - 1, 0.3 * np.cos(3 * s)], -1).reshape(-1, 3)
    normals = np.stack([0.45 * np.sin(3 * s), 0 * s, np.ones_like(s)], -1)
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).reshape(-1, 3)
    uv = np.stack([s, t], -1).reshape(-1, 2)
    faces = [f for i in range(n * (n - 1)) if i % n < n - 1 for f in ((i, i + 1, i + n + 1), (i, i + n + 1, i + n))]
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points] + [f"vt {u} {v}" for u, v in uv]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}/{i + 1}" for i in face) for face in faces]
    (folder / "wave.obj").write_text("\n".join(lines) + "\n")
    # version 4: magic, version, then packed: flags (normals, texture coordinates, single precision), name, numbers, arrays
    packed = struct.pack("<I", 0x1003) + b"wave\0" + struct.pack("<QQ", len(points), len(faces))
    packed += b"".join(np.asarray(a, "<f4").tobytes() for a in (points, normals, uv)) + np.asarray(faces, "<u4").tobytes()
    data = struct.pack("<HH", 0x041C, 4) + zlib.compress(packed, 9)
    (folder / "wave.serialized").write_bytes(data + struct.pack("<QI", 0, 1))


FILES = [PAINT, "paint.jpg", "paint.exr", "grey.png", "hills.png", "normals.png", "wave.obj", "wave.serialized"]
