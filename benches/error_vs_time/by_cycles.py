"""A scene of Mitsuba's rendered by Cycles (bpy): `by_cycles.py export XML OUT.npz NAME=VALUE..`, then `by_cycles.py render IN.npz OUT.exr SIZE SPP SEED MAX_DEPTH LIGHT_TREE`.

What is told to both alike: meshes, rectangles and spheres (fine meshes here), diffuse and one-sided emitting surfaces, squares of two colours, a
perspective camera; rough metals are Cycles' glossy surface of the same colour at normal incidence and roughness, which is nearly the same. Cycles is
used as it is best for such scenes: on all cores, without denoising, adaptive sampling and clamping, box filter. Prints the CPU seconds of
rendering, in which its tree is built.
"""
import json
import math
import resource
import sys

import numpy as np


def export(xml: str, out: str, values: dict) -> None:
    """Triangles by shape, and what they are made of."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    scene = mi.load_file(xml, **values)
    arrays, materials = {}, []
    for number, shape in enumerate(scene.shapes()):
        vertices, faces, uv = triangles(mi, shape)
        arrays |= {f"v{number}": vertices, f"f{number}": faces, f"u{number}": uv}
        materials.append(material(mi, shape))
    sensor = mi.traverse(scene.sensors()[0])
    arrays["camera"] = np.array(sensor["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    arrays["told"] = np.array(json.dumps({"fov": float(sensor["x_fov"]), "materials": materials}))
    np.savez(out, **arrays)


def triangles(mi, shape) -> tuple:
    told = mi.traverse(shape)
    if "faces" in dict(told.items()):
        vertices = np.array(told["vertex_positions"]).reshape(-1, 3)
        uv = np.array(told["vertex_texcoords"]).reshape(-1, 2)
        return vertices, np.array(told["faces"]).reshape(-1, 3).astype(np.int32), uv if len(uv) else np.zeros((len(vertices), 2))
    to_world = np.array(told["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    kind = shape.class_name()
    if kind == "Rectangle":
        local = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
        faces, uv = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32), (local[:, :2] + 1) / 2
    elif kind == "Sphere":
        local, faces = ball(96)
        uv = np.zeros((len(local), 2))
    else:
        raise SystemExit(f"{kind} is no shape that is told to Cycles")
    return local @ to_world[:3, :3].T + to_world[:3, 3], faces, uv


def ball(n: int) -> tuple:
    """A unit sphere of n rings."""
    vertices, faces = [], []
    for i in range(n + 1):
        for j in range(2 * n):
            a, b = math.pi * i / n, math.pi * j / n
            vertices.append([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])
    for i in range(n):
        for j in range(2 * n):
            a, b, c, d = (i * 2 * n + j, (i + 1) * 2 * n + j, (i + 1) * 2 * n + (j + 1) % (2 * n), i * 2 * n + (j + 1) % (2 * n))
            faces += [[a, b, c], [a, c, d]]
    return np.array(vertices), np.array(faces, dtype=np.int32)


def material(mi, shape) -> dict:
    """Colours by what they are called in the scene's parameters."""
    told = {}
    for owner, what in (("bsdf", shape.bsdf()), ("emitter", shape.emitter())):
        if what is not None:
            told |= {f"{owner}.{key}": value for key, value in dict(mi.traverse(what)).items()}

    def find(end: str):
        return next((value for key, value in told.items() if key.endswith(end)), None)

    def color(value) -> list:
        flat = np.array(value, dtype=np.float64).ravel()
        return [float(x) for x in (flat if len(flat) == 3 else flat.repeat(3)[:3])]

    out = {"emission": color(find("radiance.value"))} if find("radiance.value") is not None else {}
    if find("color0.value") is not None:
        to_uv = np.array(find("to_uv").matrix, dtype=np.float64)
        return out | {"squares": [color(find("color0.value")), color(find("color1.value"))], "times": [float(to_uv[0, 0]), float(to_uv[1, 1])]}
    if find("reflectance.value") is not None and find("alpha.value") is None:
        return out | {"diffuse": color(find("reflectance.value"))}
    if find("alpha.value") is not None and find("k.value") is not None:
        eta, k = np.array(color(find("eta.value"))), np.array(color(find("k.value")))
        return out | {"metal": [float(x) for x in ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)], "alpha": float(np.array(find("alpha.value")).ravel()[0])}
    raise SystemExit(f"a material of {sorted(told)} is none that is told to Cycles")


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def render(scene: str, out: str, size: int, spp: int, seed: int, max_depth: int, light_tree: bool) -> None:
    import bpy
    import mathutils

    data = np.load(scene)
    told = json.loads(str(data["told"]))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    at = bpy.context.scene
    known = {}
    for number, of in enumerate(told["materials"]):
        key = json.dumps(of)
        if key not in known:
            known[key] = surface(bpy, of)
        mesh(bpy, at, f"m{number}", data[f"v{number}"], data[f"f{number}"], data[f"u{number}"], known[key])
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit, camera.angle, camera.clip_start = "HORIZONTAL", math.radians(told["fov"]), 1e-4
    eye = bpy.data.objects.new("camera", camera)
    at.collection.objects.link(eye)
    at.camera = eye
    # Mitsuba looks along +z with x to the left, Blender along -z with x to the right
    eye.matrix_world = mathutils.Matrix((data["camera"] @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist())
    settings(at, size, max_depth, light_tree)
    at.cycles.samples, at.cycles.seed, at.render.filepath = spp, seed % 2**31, out
    start = cpu()
    bpy.ops.render.render(write_still=True)
    print(cpu() - start)


def mesh(bpy, at, name: str, vertices, faces, uv, look) -> None:
    m = bpy.data.meshes.new(name)
    m.vertices.add(len(vertices))
    m.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    m.loops.add(faces.size)
    m.loops.foreach_set("vertex_index", faces.ravel())
    m.polygons.add(len(faces))
    m.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    m.uv_layers.new().uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    m.update()
    m.materials.append(look)
    at.collection.objects.link(bpy.data.objects.new(name, m))


def surface(bpy, of: dict):
    look = bpy.data.materials.new("m")
    look.use_nodes = True
    tree = look.node_tree
    tree.nodes.clear()

    def node(kind: str, **inputs):
        made = tree.nodes.new(kind)
        for key, value in inputs.items():
            made.inputs[key.replace("_", " ")].default_value = value
        return made

    if "squares" in of:
        shown = node("ShaderNodeBsdfDiffuse")
        checker = node("ShaderNodeTexChecker", Scale=1.0, Color1=(*of["squares"][1], 1), Color2=(*of["squares"][0], 1))
        times = node("ShaderNodeMapping")
        # two squares where Mitsuba's pattern repeats once
        times.inputs["Scale"].default_value = (2 * of["times"][0], 2 * of["times"][1], 1)
        tree.links.new(node("ShaderNodeTexCoord").outputs["UV"], times.inputs["Vector"])
        tree.links.new(times.outputs[0], checker.inputs["Vector"])
        tree.links.new(checker.outputs["Color"], shown.inputs["Color"])
    elif "metal" in of:
        shown = node("ShaderNodeBsdfAnisotropic", Color=(*of["metal"], 1), Roughness=math.sqrt(of["alpha"]))
    else:
        shown = node("ShaderNodeBsdfDiffuse", Color=(*of["diffuse"], 1))
    if "emission" in of:
        # colours above 1 belong into the strength
        strength = max(*of["emission"], 1e-9)
        light = node("ShaderNodeEmission", Color=(*[x / strength for x in of["emission"]], 1), Strength=strength)
        # in front what it reflects as well, behind nothing
        front, both = node("ShaderNodeAddShader"), node("ShaderNodeMixShader")
        dark = node("ShaderNodeBsdfDiffuse", Color=(0, 0, 0, 1))
        tree.links.new(light.outputs[0], front.inputs[0])
        tree.links.new(shown.outputs[0], front.inputs[1])
        tree.links.new(node("ShaderNodeNewGeometry").outputs["Backfacing"], both.inputs[0])
        tree.links.new(front.outputs[0], both.inputs[1])
        tree.links.new(dark.outputs[0], both.inputs[2])
        shown = both
        look.cycles.emission_sampling = "FRONT"
    tree.links.new(shown.outputs[0], node("ShaderNodeOutputMaterial").inputs["Surface"])
    return look


def settings(at, size: int, max_depth: int, light_tree: bool) -> None:
    at.render.engine = "CYCLES"
    c = at.cycles
    c.device, c.use_denoising, c.use_adaptive_sampling = "CPU", False, False
    c.sample_clamp_direct = c.sample_clamp_indirect = c.blur_glossy = 0
    # Mitsuba counts rays: the camera's, and the one to the light
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = c.transmission_bounces = max_depth - 2
    c.caustics_reflective = c.caustics_refractive = True
    c.pixel_filter_type, c.use_light_tree, c.use_auto_tile = "BOX", light_tree, False
    at.render.resolution_x = at.render.resolution_y = size
    at.render.resolution_percentage = 100
    view, image = at.view_settings, at.render.image_settings
    view.view_transform, view.look, view.exposure, view.gamma = "Raw", "None", 0, 1
    image.file_format, image.color_depth, image.exr_codec, image.color_mode = "OPEN_EXR", "32", "NONE", "RGB"


if __name__ == "__main__":
    if sys.argv[1] == "export":
        export(sys.argv[2], sys.argv[3], dict(kv.split("=") for kv in sys.argv[4:]))
    else:
        render(sys.argv[2], sys.argv[3], *map(int, sys.argv[4:8]), sys.argv[8] == "1")
