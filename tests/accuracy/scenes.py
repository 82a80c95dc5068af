"""The scenes that both renderers read, as one file each: box filter, integrator `path`, size and depth as parameters."""
import re
import subprocess
import sys
import tarfile
from pathlib import Path

NAMES = ["cornell", "cornell-box", "veach-mis", "gyroid", "staircase", "living-room", "classroom", "dining-room", "furnace", "ajar-door", "still-life", "house", "bunny"]
# of ../../examples; house is made by `rayherd scene house`
OURS = ["furnace", "ajar-door", "still-life"]
# of `rayherd scene many-lights`: how many lamps
MANY_LIGHTS = {"many-lights-100": 100, "many-lights-1000": 1000, "many-lights-10000": 10000}
# of ../shared/data, and which of their files: dining-room's other one lacks its sky
ROOMS = {"staircase": "scene.xml", "living-room": "scene.xml", "classroom": "scene.xml", "dining-room": "scene_sunsky.xml"}
# samples of one render and number of renders: three standard errors below 0.5 % of each channel's mean. Nearly all of veach-mis' noise is
# in one pixel, which shows part of its smallest light and holds a fifth of the picture's energy
ENOUGH = {"veach-mis": (768, 64), "classroom": (128, 64), "dining-room": (128, 64), "ajar-door": (256, 64)}

# Mitsuba starts a ray 8.9e-5 (1 + the largest coordinate) off its surface: 1.4e-3 at veach-mis' front edge, which moves the edges of shadows there by
# 1/100 of a pixel, so that their rows of pixels differ by up to 1.7 %. It is a third of that where the front edge is near the origin
VEACH_SHIFT = -12.0

# rows of tiles, of 16 from the top, that may lie beyond four standard errors for a reason that is not ours; of all others at most 3 tiles may. A wrong light or material
# shows in all rows. veach-mis: 13 and 14, where the floor meets the wall (that shift of shadows' edges, what of it VEACH_SHIFT leaves), and 11, the rough plate (Mitsuba's
# fit of Beckmann's masking, 0.35 % at grazing angles): the more samples, the more of their tiles stand out. sky and sunsky: 0 and 1, where the sky itself is seen, without noise, the
# horizon in row 1: the picture that stands for the model is 0.01 % off, and up to 4 % within 0.2 degrees of the horizon (docs/formats.md)
ROWS = {"veach-mis": {11, 13, 14}, "sky": {0, 1}, "sunsky": {0, 1}}
# more tiles than 3 that may. bitmap-jpeg: 9 to 11 were seen at 256 x 16, where the textured ball and sheet are; decoders of JPEG with half-sized colour differ by a level
# here and there, which makes +0.04, -0.01, +0.02 % of the means (benches/results, ninth session: +0.10, -0.08, +0.16 % of the texture's)
TILES = {"bitmap-jpeg": 16}

# one small scene per material: a ball and a tilted plate of it over a grey floor, a large light above, a sky
MATERIALS = {
    "diffuse": '<bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.5, 0.2"/></bsdf>',
    "conductor": '<bsdf type="conductor"><string name="material" value="Au"/></bsdf>',
    "roughconductor": '<bsdf type="roughconductor"><string name="material" value="Cu"/><float name="alpha" value="0.3"/></bsdf>',
    "roughconductor-ggx": '<bsdf type="roughconductor"><string name="material" value="Ag"/><float name="alpha" value="0.4"/>'
    '<string name="distribution" value="ggx"/></bsdf>',
    "dielectric": '<bsdf type="dielectric"/>',
    "thindielectric": '<bsdf type="thindielectric"><float name="int_ior" value="1.8"/></bsdf>',
    "roughdielectric": '<bsdf type="roughdielectric"><float name="alpha" value="0.2"/></bsdf>',
    "roughdielectric-ggx": '<bsdf type="roughdielectric"><float name="alpha" value="0.5"/>'
    '<string name="distribution" value="ggx"/><rgb name="specular_transmittance" value="0.9, 0.6, 0.8"/></bsdf>',
    "plastic": '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.2, 0.5, 0.8"/></bsdf>',
    "plastic-nonlinear": '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.2, 0.5, 0.8"/>'
    '<boolean name="nonlinear" value="true"/></bsdf>',
    "roughplastic": '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.2, 0.5, 0.8"/>'
    '<float name="alpha" value="0.2"/></bsdf>',
    "roughplastic-ggx": '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.9, 0.5, 0.1"/>'
    '<float name="alpha" value="0.4"/><string name="distribution" value="ggx"/><boolean name="nonlinear" value="true"/></bsdf>',
    "principled": '<bsdf type="principled"><rgb name="base_color" value="0.8, 0.4, 0.1"/><float name="roughness" value="0.4"/>'
    '<float name="metallic" value="0.3"/><float name="clearcoat" value="0.6"/><float name="sheen" value="0.5"/></bsdf>',
    "principled-glass": '<bsdf type="principled"><rgb name="base_color" value="0.9, 0.8, 0.6"/><float name="roughness" value="0.3"/>'
    '<float name="spec_trans" value="0.8"/><float name="eta" value="1.5"/></bsdf>',
    "blendbsdf": '<bsdf type="blendbsdf"><float name="weight" value="0.3"/><bsdf type="diffuse">'
    '<rgb name="reflectance" value="0.8, 0.5, 0.2"/></bsdf><bsdf type="roughconductor"><string name="material" value="Cu"/>'
    '<float name="alpha" value="0.3"/></bsdf></bsdf>',
}

SMALL = """<scene version="3.0.0">
<default name="res" value="128"/><default name="spp" value="16"/><default name="max_depth" value="8"/>
<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="perspective"><float name="fov" value="38"/>
<transform name="to_world"><lookat origin="0, 2.2, 6" target="0, 0.8, 0" up="0, 1, 0"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/><rfilter type="box"/></film></sensor>
<emitter type="constant"><rgb name="radiance" value="0.4, 0.5, 0.6"/></emitter>
<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="90"/><translate x="1" y="5" z="1"/></transform>
<emitter type="area"><rgb name="radiance" value="4, 3.5, 3"/></emitter></shape>
<shape type="rectangle"><transform name="to_world"><scale value="6"/><rotate x="1" angle="-90"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.45, 0.4"/></bsdf></shape>
<shape type="sphere"><point name="center" x="-0.9" y="1" z="0"/><float name="radius" value="0.9"/>MATERIAL</shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.9"/><rotate x="1" angle="-35"/><rotate y="1" angle="-15"/>
<translate x="1.2" y="1" z="0.2"/></transform>MATERIAL</shape>
</scene>
"""

# before the ball and the plate, on the floor; the file's triangles face inwards
BUNNY = ('<shape type="ply"><string name="filename" value="bunny.ply"/><transform name="to_world"><scale value="8"/>'
         '<translate x="0.3" y="-0.264" z="2.2"/></transform>' + f'<bsdf type="twosided">{MATERIALS["roughplastic"]}</bsdf></shape>\n')

# one small scene per emitter, sensor and shape that is not a mesh: a ball, a copper block and a pillar on a floor
ENVMAP = ('<emitter type="envmap"><string name="filename" value="sky.hdr"/><float name="scale" value="0.7"/><transform name="to_world">'
          '<rotate x="1" angle="25"/><rotate y="1" angle="70"/></transform></emitter>')
DISK = ('<shape type="disk"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/><translate x="0.3" y="2.4"/></transform>'
        '<emitter type="area"><rgb name="radiance" value="12, 10, 8"/></emitter></shape>')
FOV = '<float name="fov" value="40"/>'
# a lamp, and a picture
GLOW = ('<shape type="rectangle"><transform name="to_world"><scale x="0.8" y="0.5"/><rotate x="1" angle="90"/><translate x="0.3" y="2.4"/></transform>'
        '<emitter type="area">RADIANCE</emitter></shape>')
SLIDE = '<texture type="bitmap" name="NAME"><string name="filename" value="slide.hdr"/><string name="wrap_mode" value="clamp"/></texture>'
# emitters; the sensor's type and what it has
EMITTERS = {
    "envmap": (ENVMAP, "perspective", FOV),
    "point": ('<emitter type="point"><point name="position" x="1" y="2" z="1"/><rgb name="intensity" value="8, 6, 5"/></emitter>',
              "perspective", FOV),
    "spot": ('<emitter type="spot"><transform name="to_world"><lookat origin="1, 3, 1" target="-0.3, 0.3, 0" up="0, 1, 0"/></transform>'
             '<float name="cutoff_angle" value="25"/><float name="beam_width" value="10"/><rgb name="intensity" value="28, 26, 15"/></emitter>',
             "perspective", FOV),
    "directional": ('<emitter type="directional"><vector name="direction" x="-1" y="-2" z="-0.7"/><rgb name="irradiance" value="3, 2, 1"/>'
                    '</emitter><emitter type="constant"><rgb name="radiance" value="0.1, 0.2, 0.3"/></emitter>', "perspective", FOV),
    "sunsky": ('<emitter type="sunsky"><vector name="sun_direction" x="0.5" y="0.6" z="0.3"/><float name="turbidity" value="4"/>'
               '<rgb name="albedo" value="0.1, 0.3, 0.2"/><float name="sky_scale" value="10"/><float name="sun_scale" value="5"/>'
               '<float name="sun_aperture" value="6"/><transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>',
               "perspective", FOV),
    "sun": ('<emitter type="sunsky"><vector name="sun_direction" x="-0.5" y="0.2" z="0.3"/><float name="sky_scale" value="0"/>'
            '<float name="sun_aperture" value="20"/><transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>',
            "perspective", FOV),
    "sky": ('<emitter type="sunsky"><vector name="sun_direction" x="-0.5" y="0.5" z="-0.3"/><float name="sun_scale" value="0"/>'
            '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>', "perspective", FOV),
    "disk": (DISK, "perspective", FOV),
    "area-checkerboard": (GLOW.replace("RADIANCE", '<texture type="checkerboard" name="radiance"><spectrum name="color0" value="9"/>'
                                       '<rgb name="color1" value="0.2, 0.5, 1"/><transform name="to_uv"><scale x="3" y="2"/></transform></texture>'),
                          "perspective", FOV),
    "area-bitmap": (GLOW.replace("RADIANCE", SLIDE.replace("NAME", "radiance")), "perspective", FOV),
    "spot-texture": ('<emitter type="spot"><transform name="to_world"><lookat origin="1, 3, 1" target="-0.3, 0.3, 0" up="0, 1, 0"/></transform>'
                     '<float name="cutoff_angle" value="30"/><float name="beam_width" value="25"/><rgb name="intensity" value="28, 26, 15"/>'
                     + SLIDE.replace("NAME", "texture") + "</emitter>", "perspective", FOV),
    # coloured sheets that reflect by their vertices and by their faces (Mitsuba 3.9 samples no lamp whose radiance is a mesh attribute: it is dark)
    "mesh-attribute": (DISK + '<shape type="ply"><string name="filename" value="sheet.ply"/><transform name="to_world"><rotate x="1" angle="-20"/>'
                       '<translate x="-0.3" y="0.9" z="-0.9"/></transform><bsdf type="twosided"><bsdf type="diffuse"><texture '
                       'type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture></bsdf></bsdf></shape>'
                       '<shape type="ply"><string name="filename" value="sheet.ply"/><transform name="to_world"><scale value="0.6"/>'
                       '<rotate y="1" angle="-40"/><translate x="1.3" y="1.2" z="-0.5"/></transform><bsdf type="twosided"><bsdf '
                       'type="diffuse"><texture type="mesh_attribute" name="reflectance"><string name="name" value="face_glow"/>'
                       '<float name="scale" value="0.4"/></texture></bsdf></bsdf></shape>', "perspective", FOV),
    "thinlens": (DISK, "thinlens", FOV + '<float name="aperture_radius" value="0.3"/><float name="focus_distance" value="4"/>'),
    "orthographic": (DISK, "orthographic", ""),
    "instances": (ENVMAP + '<shape type="shapegroup" id="g"><shape type="sphere"><float name="radius" value="0.2"/></shape>'
                  '<shape type="cube"><transform name="to_world"><scale value="0.15"/><translate y="0.35"/></transform></shape></shape>'
                  + "".join(f'<shape type="instance"><ref id="g"/><transform name="to_world"><scale value="{1 + 0.3 * i}"/><rotate z="1" '
                            f'angle="{15 * i}"/><translate x="{i - 1.5}" y="1.4" z="0.5"/></transform></shape>' for i in range(4)),
                  "perspective", FOV),
}

LIT = """<scene version="3.0.0">
<default name="res" value="128"/><default name="spp" value="16"/><default name="max_depth" value="8"/>
<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>
<sensor type="SENSOR">LENS
<transform name="to_world"><scale x="2" y="2"/><lookat origin="0, 2, 5" target="0, 0.5, 0" up="0, 1, 0"/></transform>
<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
<film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/><rfilter type="box"/></film></sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></shape>
<shape type="sphere"><point name="center" x="-0.8" y="0.6" z="0"/><float name="radius" value="0.6"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.5, 0.7"/></bsdf></shape>
<shape type="cube"><transform name="to_world"><scale value="0.4"/><rotate y="1" angle="30"/><translate x="0.8" y="0.4"/></transform>
<bsdf type="roughconductor"><string name="material" value="Cu"/><float name="alpha" value="0.2"/></bsdf></shape>
<shape type="cylinder"><point name="p0" x="-1.5" y="0" z="-1"/><point name="p1" x="-1" y="1.6" z="-1.2"/><float name="radius" value="0.2"/>
<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
EMITTER
</scene>
"""


def sky(with_sun: bool = True) -> bytes:
    """A picture of 64 x 32 pixels in RGBE: patches of colour, dark ones among them, and perhaps a small sun."""
    rows = bytearray(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 32 +X 64\n")
    for y in range(32):
        for x in range(64):
            a, b, c = (x * 37 + y * 91) % 256, (x * 11 + y * 57 + 80) % 256, (x * 73 + y * 23 + 160) % 256
            if a > b > c:
                a = b = c = 0
            sun = with_sun and (x, y) in [(20, 8), (20, 9)]
            # no pixel begins with 2, 2 or is 1, 1, 1, which would be a run
            rows += bytes([200, 180, 150, 137]) if sun else bytes([a | 4, b | 4, c | 4, 128])
    return bytes(rows)


def sheet() -> str:
    """A PLY of 5 x 5 quads, two units wide, front to +z, whose vertices and faces have colours."""
    n = 6
    out = ["ply", "format ascii 1.0", f"element vertex {n * n}"]
    out += [f"property float {p}" for p in ("x", "y", "z", "r", "g", "b")]
    out += [f"element face {2 * (n - 1) ** 2}", "property list uchar int vertex_indices"]
    out += [f"property float glow_{p}" for p in "xyz"] + ["end_header"]
    for i in range(n * n):
        s, t = (i % n) / (n - 1), (i // n) / (n - 1)
        out.append(f"{2 * s - 1} {2 * t - 1} 0 {s} {t} {1 - s * t}")
    for i in (i for i in range(n * (n - 1)) if i % n < n - 1):
        glow = f"{(i * 7 % 5) / 2} {(i * 3 % 4) / 2} {(i * 5 % 3)}"
        out += [f"3 {i} {i + 1} {i + n + 1} {glow}", f"3 {i} {i + n + 1} {i + n} {glow}"]
    return "\n".join(out) + "\n"


def prepare(name: str, shared: Path, work: Path, rayherd: str = "rayherd", size: int = 128) -> Path:
    """Leaves the scene under `work` and returns its XML. Parameters: res (or resx, resy), spp, max_depth; `size` is that of the picture where a
    parameter cannot say it."""
    import features

    if name in features.FEATURES:
        features.write_files(work)
        (work / "sky.hdr").write_bytes(sky())
        out = work / f"feature-{name}.xml"
        out.write_text(features.text(name, size))
        return out
    if name == "cornell":
        out = work / "cornell.xml"
        out.write_text((shared / "peers/refs/cornell.xml").read_text())
        return out
    if name in ["cornell-box", "veach-mis"]:
        with tarfile.open(shared / f"data/scene-{name}/scene-{name}.tar.xz") as tar:
            tar.extractall(work / name, filter="data")
        source = next((work / name).rglob("scene.xml"))
        text = source.read_text()
        text = text.replace('value="path_guiding_integrator"', 'value="path"')
        text = re.sub(r'<rfilter type="\w+"', '<rfilter type="box"', text)
        out = source.with_name("scene-box.xml")
        out.write_text(moved(text, VEACH_SHIFT) if name == "veach-mis" else text)
        return out
    if name in ROOMS:
        with tarfile.open(shared / f"data/scene-{name}/scene-{name}.tar.xz") as tar:
            tar.extractall(work / name, filter="data")
        source = next((work / name).rglob(ROOMS[name]))
        text = re.sub(r'type="(tent|gaussian)"', 'type="box"', source.read_text())
        return write_room(text, source.with_name("scene-box.xml"))
    if name == "gyroid":
        out = work / "scenes/gyroid.xml"
        if not out.exists():  # 1,002,500 triangles
            subprocess.run([sys.executable, shared / "peers/make_scene.py", "148"], cwd=work, check=True)
        return out
    if name in OURS:
        out = work / f"{name}.xml"
        out.write_text((Path(__file__).resolve().parents[2] / f"examples/{name}.xml").read_text())
        return out
    if name in MANY_LIGHTS:
        out = work / f"{name}.xml"
        subprocess.run([rayherd, "scene", "many-lights", str(MANY_LIGHTS[name]), "-o", out], check=True, stdout=subprocess.DEVNULL)
        return out
    if name == "house":
        subprocess.run([rayherd, "scene", "house", "--size", "2", work / "house"], check=True, stdout=subprocess.DEVNULL)
        return work / "house/house.xml"
    if name == "bunny":
        # the one of shared/data's meshes that Mitsuba 3.9 reads: lucy has a line of obj_info, the dragons are compressed
        with tarfile.open(shared / "data/meshes/meshes.tar.xz") as tar:
            member = next(m for m in tar.getmembers() if m.name.endswith("bunny.ply"))
            (work / "bunny.ply").write_bytes(tar.extractfile(member).read())
        out = work / "bunny.xml"
        out.write_text(SMALL.replace("MATERIAL", MATERIALS["diffuse"]).replace("</scene>", BUNNY + "</scene>"))
        return out
    if name in MATERIALS:
        out = work / f"material-{name}.xml"
        out.write_text(SMALL.replace("MATERIAL", MATERIALS[name]))
        return out
    if name in EMITTERS:
        emitter, sensor, lens = EMITTERS[name]
        (work / "sky.hdr").write_bytes(sky())
        (work / "slide.hdr").write_bytes(sky(with_sun=False))
        (work / "sheet.ply").write_text(sheet())
        out = work / f"emitter-{name}.xml"
        text = LIT.replace("SENSOR", sensor).replace("LENS", lens).replace("EMITTER", emitter)
        # a scale of the map is the width of a parallel view; a perspective one has none
        out.write_text(text if sensor == "orthographic" else text.replace('<scale x="2" y="2"/>', ""))
        return out
    there = ", ".join([*NAMES, *MANY_LIGHTS, *MATERIALS, *EMITTERS, *features.FEATURES])
    raise SystemExit(f"unknown scene {name}; there are {there}; materials, emitters or features for all of these")


def write_room(text: str, out: Path, side: tuple[str, str] = ("$res", "$res")) -> Path:
    """Writes a room of shared/data as both renderers read it, with a film of these sides."""
    # photon maps
    text = text.replace('name="method" value="sppm"', 'name="method" value="path"')
    text = re.sub(r'<\w+ name="(photonCount|maxPasses|stepSnapshot|kNN|dualBuffer)"[^>]*/>', "", text)
    text = re.sub(r'<boolean name="banner"[^>]*/>|<float name="gamma" value="2.2" */>', "", text)
    for name, length in zip(["width", "height"], side):
        text = re.sub(rf'(name="{name}" value=)"\d+"', rf'\1"{length}"', text)
    text = re.sub(r'(name="maxDepth" value=)"-?\d+"', r'\1"$max_depth"', text)
    # Mitsuba 3 refuses what it does not know
    text = re.sub(r'<boolean name="(?:highQualityEdges|high_quality_edges)"[^>]*/>', "", text)
    defaults = '<default name="res" value="128"/><default name="max_depth" value="65"/>'
    text = re.sub(r"(<scene[^>]*>)", r"\1" + defaults, text, count=1)
    out.write_text(text)
    if "sunsky" in text:
        theirs(out).write_text(for_mitsuba(text))
    return out


def moved(text: str, dx: float) -> str:
    """A scene of matrices and spheres, moved along x."""

    def matrix(found: re.Match) -> str:
        m = found[1].split()
        m[3] = repr(float(m[3]) + dx)
        return f'<matrix value="{" ".join(m)}"'

    text = re.sub(r'<matrix value="([^"]*)"', matrix, text)
    return re.sub(r'name="center" x="([^"]*)"', lambda x: f'name="center" x="{float(x[1]) + dx!r}"', text)


def theirs(xml: Path) -> Path:
    """Where the file that Mitsuba 3 reads lies, if it is another one."""
    return xml.with_name(xml.stem + "-mitsuba.xml")


def read_by_mitsuba(xml: Path) -> Path:
    return theirs(xml) if theirs(xml).exists() else xml


def for_mitsuba(text: str) -> str:
    """A scene of 0.6 with a sky, as Mitsuba 3 has to be told the same: z was y, other names, another default; and bilinear textures."""
    scale = re.search(r'<float name="sunRadiusScale" value="([^"]*)" */>', text)
    aperture = f'<float name="sun_aperture" value="{0.5358 * float(scale[1])}"/>'
    up = '<transform name="to_world"><rotate x="1" angle="-90"/></transform><rgb name="albedo" value="0.15"/>'
    text = re.sub(r'<float name="extEta" value="1" */>', "", text)
    return text.replace(scale[0], aperture + up).replace('value="trilinear"', 'value="bilinear"')


def parameters(xml: Path, size: int, max_depth: int) -> dict:
    """Values for those of the XML's parameters that set size and depth (Mitsuba refuses any that a file does not use)."""
    text = xml.read_text()
    values = {"res": size, "resx": size, "resy": size, "max_depth": max_depth}
    if "$max_depth" not in text and f'name="max_depth" value="{max_depth}"' not in text:
        raise SystemExit(f"{xml} fixes another depth than {max_depth}")
    return {k: v for k, v in values.items() if re.search(rf"\${k}\b", text)}
