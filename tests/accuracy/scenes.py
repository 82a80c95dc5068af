"""The scenes that both renderers read, as one file each: box filter, integrator `path`, size and depth as parameters."""
import re
import subprocess
import sys
import tarfile
from pathlib import Path

NAMES = ["cornell", "veach-mis", "gyroid"]


def prepare(name: str, shared: Path, work: Path) -> Path:
    """Leaves the scene under `work` and returns its XML. Parameters: res (or resx, resy), spp, max_depth."""
    if name == "cornell":
        out = work / "cornell.xml"
        out.write_text((shared / "peers/refs/cornell.xml").read_text())
        return out
    if name == "veach-mis":
        with tarfile.open(shared / "data/scene-veach-mis/scene-veach-mis.tar.xz") as tar:
            tar.extractall(work / "veach-mis", filter="data")
        source = next((work / "veach-mis").rglob("scene.xml"))
        text = source.read_text()
        text = text.replace('value="path_guiding_integrator"', 'value="path"')
        text = re.sub(r'<rfilter type="\w+"', '<rfilter type="box"', text)
        out = source.with_name("scene-box.xml")
        out.write_text(text)
        return out
    if name == "gyroid":
        out = work / "scenes/gyroid.xml"
        if not out.exists():  # 1,002,500 triangles
            subprocess.run([sys.executable, shared / "peers/make_scene.py", "148"], cwd=work, check=True)
        return out
    raise SystemExit(f"unknown scene {name}; there are {', '.join(NAMES)}")


def parameters(xml: Path, size: int, max_depth: int) -> dict:
    """Values for those of the XML's parameters that set size and depth (Mitsuba refuses any that a file does not use)."""
    text = xml.read_text()
    values = {"res": size, "resx": size, "resy": size, "max_depth": max_depth}
    if "$max_depth" not in text and f'name="max_depth" value="{max_depth}"' not in text:
        raise SystemExit(f"{xml} fixes another depth than {max_depth}")
    return {k: v for k, v in values.items() if re.search(rf"\${k}\b", text)}
