"""Make a folder of textured meshes of table-top size from Debian's package `sweethome3d-furniture`.

`python scripts/fetch_furniture.py furniture` downloads the package with `apt-get download` (120 MB; the models are CC0
or CC-BY 3.0), takes the models whose catalogue size suits a table, and writes them as OBJ files in metres, z up, each
with one texture. `credits.json` lists title, author and licence of every model; `objectflow generate --mesh-folder`
copies the entries of the models that it uses into the data set. The package is a source of data for users and no part
of this project.
"""

from __future__ import annotations

import dataclasses
import io
import json
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import cv2
import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.objects.mesh_files import MeshFile, read_mesh
from objectflow.typing import Float64Array

PACKAGE = "sweethome3d-furniture"
CATALOGUE = "PluginFurnitureCatalog.properties"
LICENSES = {"BlendSwap-CC-0": "CC0 1.0", "BlendSwap-CC-BY": "CC-BY 3.0", "Scopia": "CC-BY 3.0"}
"""Licence by the name of the library; that of all others is `OTHER_LICENSE`, as the package's copyright file says."""
OTHER_LICENSE = "CC-BY 3.0 US"
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The package's models have y up."""


@dataclasses.dataclass
class Settings:
    """Fetch and convert the models."""

    out: Positional[Path]
    """Folder to write; existing files are replaced."""
    deb: Path | None = None
    """The package's file, if it is already here; otherwise it is downloaded."""
    size: tuple[float, float] = (0.04, 0.42)
    """Minimum and maximum longest side of a model, metres."""
    thinnest: float = 0.004
    """Minimum shortest side of a model, metres."""
    faces: int = 12_000
    """Maximum number of triangles: larger models slow down the ray tracer."""
    texture: int = 256
    """Maximum side length of a texture, pixels: the ray tracer has no mip maps, and larger ones would alias."""


def main(settings: Settings) -> int:
    """Convert every suitable model; print the number and what was left out."""
    credits: dict[str, dict[str, str]] = {}
    skipped: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        deb = settings.deb or download(Path(folder))
        subprocess.run(["dpkg-deb", "-x", str(deb), folder], check=True)
        libraries = sorted(Path(folder).glob("usr/share/sweethome3d/furniture/*.sh3f"))
        if not libraries:
            raise ObjectflowError(f"{deb} holds no furniture libraries: is it the package {PACKAGE}?")
        for path in libraries:
            with zipfile.ZipFile(path) as library:
                for entry in read_catalogue(library.read(CATALOGUE).decode("latin1")):
                    reason, name = convert(library, path.stem, entry, settings)
                    if reason:
                        skipped[reason] = skipped.get(reason, 0) + 1
                    else:
                        credits[name] = {
                            "title": entry["name"],
                            "author": entry.get("creator", "unknown"),
                            "license": LICENSES.get(path.stem, OTHER_LICENSE),
                            "source": f"Debian package {PACKAGE}, {path.name}, {entry['model'].lstrip('/')}",
                        }
    (settings.out / "credits.json").write_text(json.dumps(credits, indent=1, sort_keys=True) + "\n")
    print(f"{len(credits)} models in {settings.out}; left out: {skipped}")
    return 0


def download(folder: Path) -> Path:
    """Download the package into a folder.

    Raises:
        ObjectflowError: apt-get cannot fetch it.
    """
    try:
        subprocess.run(["apt-get", "download", PACKAGE], cwd=folder, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise ObjectflowError(
            f"apt-get cannot fetch {PACKAGE}: on another system download its .deb from packages.debian.org "
            "and give it as --deb FILE"
        ) from error
    return next(folder.glob("*.deb"))


def read_catalogue(text: str) -> list[dict[str, str]]:
    """The entries of a catalogue, each with the properties `name`, `model`, `width`, `depth`, `height`, ..."""
    entries: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        match = re.fullmatch(r"(\w+)#(\d+)\s*=\s*(.*)", line.strip())
        if match:
            entries.setdefault(int(match[2]), {})[match[1]] = re.sub(
                r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), match[3]
            )
    needed = {"name", "model", "width", "depth", "height"}
    return [entry for _, entry in sorted(entries.items()) if needed <= set(entry)]


def convert(library: zipfile.ZipFile, origin: str, entry: dict[str, str], settings: Settings) -> tuple[str, str]:
    """Write one model; return why it was left out (empty if it was not) and its file's path within the folder."""
    size = np.array([float(entry[side]) / 100 for side in ("width", "height", "depth")])
    if not settings.size[0] <= size.max() <= settings.size[1]:
        return "size", ""
    if size.min() < settings.thinnest or entry.get("movable") == "false" or entry.get("doorOrWindow") == "true":
        return "flat, fixed, door or window", ""
    model = entry["model"].lstrip("/")
    try:
        mesh = unpack_mesh(library, model)
    except DatasetError:
        return "unreadable", ""
    if len(mesh.faces) > settings.faces:
        return "too many triangles", ""
    turn = np.array([float(word) for word in entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()]).reshape(3, 3)
    vertices = mesh.vertices @ turn.T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) * (size / np.maximum(high - low, 1e-9)) @ Z_UP.T
    category = re.sub(r"\W+", "-", entry.get("category", "other").lower())
    name = f"{category}/{origin.lower()}-{Path(model).stem}.obj"
    write_mesh(settings.out / name, vertices, mesh, settings.texture)
    return "", name


def unpack_mesh(library: zipfile.ZipFile, model: str) -> MeshFile:
    """Read a model of a library; its materials and textures lie beside it."""
    with tempfile.TemporaryDirectory() as folder:
        prefix = model.rpartition("/")[0] + "/"
        for name in library.namelist():
            if name.startswith(prefix) and not name.endswith("/"):
                (Path(folder) / Path(name).name).write_bytes(library.read(name))
        path = Path(folder) / Path(model).name
        if not path.is_file():
            raise DatasetError(f"{model} is not in the library")
        return read_mesh(path)


def write_mesh(path: Path, vertices: Float64Array, mesh: MeshFile, largest: int) -> None:
    """Write an OBJ file, its material library and its texture (grey if the model has none)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    texture = np.full((4, 4, 3), 180, np.uint8) if mesh.texture is None else mesh.texture
    scale = largest / max(texture.shape[:2])
    if scale < 1:
        size = (max(1, round(texture.shape[1] * scale)), max(1, round(texture.shape[0] * scale)))
        texture = cv2.resize(texture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    cv2.imwrite(str(path.with_suffix(".png")), texture[..., ::-1])
    path.with_suffix(".mtl").write_text(f"newmtl surface\nmap_Kd {path.stem}.png\n")
    out = io.StringIO()
    out.write(f"mtllib {path.stem}.mtl\nusemtl surface\n")
    np.savetxt(out, vertices, fmt="v %.6f %.6f %.6f")
    np.savetxt(out, mesh.uv, fmt="vt %.5f %.5f")
    np.savetxt(out, np.repeat(mesh.faces + 1, 2, axis=1), fmt="f %d/%d %d/%d %d/%d")
    path.write_text(out.getvalue())


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Settings)))
    except ObjectflowError as error:
        sys.exit(str(error))
