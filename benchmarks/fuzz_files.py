"""Mutated images, camera files and lists: the readers raise nothing but `ObjectflowError`, in bounded time and memory.

    python benchmarks/fuzz_files.py --count 20000

Prints the number of inputs that were read and refused, the longest time and the peak memory, and exits with 1 at the
first other exception.
"""

from __future__ import annotations

import argparse
import io
import json
import resource
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import cv2
import numpy as np

from objectflow.errors import ObjectflowError
from objectflow.readers import open_source
from objectflow.runtime.quiet import silence_stderr

WIDTH, HEIGHT = 48, 36
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 46.0, "fy": 46.0, "cx": 23.5, "cy": 17.5, "depth_scale": 1000}
MATRIX = [46.0, 0, 23.5, 0, 46.0, 17.5, 0, 0, 1]


def encoded(suffix: str, image: np.ndarray) -> bytes:
    """The bytes of an image in a format of OpenCV."""
    return cv2.imencode(suffix, image)[1].tobytes()


def exr(image: np.ndarray) -> bytes:
    """The bytes of an OpenEXR file."""
    import OpenEXR

    with tempfile.TemporaryDirectory() as folder:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Z": image}).write(f"{folder}/a.exr")
        return Path(folder, "a.exr").read_bytes()


def array(image: np.ndarray, *, zipped: bool = False) -> bytes:
    """The bytes of an NPY or NPZ file."""
    buffer = io.BytesIO()
    if zipped:
        np.savez_compressed(buffer, depth=image)
    else:
        np.save(buffer, image)
    return buffer.getvalue()


def seeds() -> dict[str, bytes]:
    """Valid files by name; each replaces one file of a valid source."""
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    units = rng.integers(900, 1100, (HEIGHT, WIDTH), dtype=np.uint16)
    metres = (units / 1000).astype(np.float32)
    out = {f"color1{suffix}": encoded(suffix, color) for suffix in (".png", ".jpg", ".bmp", ".ppm", ".webp", ".tiff")}
    out |= {"depth1.png": encoded(".png", units), "depth1.pgm": encoded(".pgm", units)}
    out |= {"depth1.tif": encoded(".tiff", units), "depth1.tiff": encoded(".tiff", metres)}
    out |= {"depth1.pfm": encoded(".pfm", metres), "depth1.exr": exr(metres)}
    out |= {"depth1.npy": array(metres), "depth1.npz": array(metres, zipped=True)}
    out["camera.json"] = json.dumps(CAMERA).encode()
    out["camera_intrinsic.json"] = json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": MATRIX}).encode()
    out["camera_info.yaml"] = (
        f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
    ).encode()
    out["K.txt"] = b"46 0 23.5\n0 46 17.5\n0 0 1\n"
    out["cameras.txt"] = f"1 OPENCV {WIDTH} {HEIGHT} 46 46 24 18 0.1 0 0 0\n".encode()
    out["rgb.txt"] = b"# list\n100.0 color0.png\n100.1 color1.png\n"
    out["associations.txt"] = b"100.0 color0.png 100.0 depth0.png\n100.1 color1.png 100.1 depth1.png\n"
    return out


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Change, insert, repeat or cut a few bytes."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(0, max(1, min(len(out), 200 if rng.random() < 0.7 else len(out)))))
        kind = rng.integers(0, 6)
        if kind == 0 and out:
            out[at % len(out)] = int(rng.integers(0, 256))
        elif kind == 1:
            out[at : at + 4] = bytes(rng.choice([0, 255, 127, 128], 4).astype(np.uint8))
        elif kind == 2:
            del out[at : at + int(rng.integers(1, 40))]
        elif kind == 3:
            out[at:at] = bytes(rng.integers(0, 256, int(rng.integers(1, 20)), dtype=np.uint8))
        elif kind == 4:
            out[at:at] = rng.choice(
                [b"9" * 30, b"-", b"nan", b"1e999", b"[" * 99, b'"', b"\x00", b"\n", b"../", b"{}"]
            )
        else:
            out = out[: int(rng.integers(0, len(out) + 1))]
    return bytes(out)


def write_source(folder: Path, name: str, data: bytes, valid: dict[str, bytes]) -> None:
    """A source that is valid but for one file."""
    files = {f"{kind}{index}.png": valid[f"{kind}1.png"] for kind in ("color", "depth") for index in (0, 1)}
    if name.startswith(("color1", "depth1")):
        del files[f"{name[:6]}.png"]
    if not name.startswith(("camera", "K")):
        files["camera.json"] = valid["camera.json"]
    if name == "rgb.txt":
        files["depth.txt"] = valid[name].replace(b"color", b"depth")
    for file, content in {**files, name: data}.items():
        (folder / file).write_bytes(content)


def main() -> int:
    """Read mutated sources and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    rng, valid = np.random.default_rng(arguments.seed), seeds()
    names, counts, slowest = list(valid), {"read": 0, "refused": 0}, (0.0, "")
    for number in range(arguments.count):
        name = names[number % len(names)]
        data = mutate(valid[name], rng)
        with tempfile.TemporaryDirectory() as folder:
            write_source(Path(folder), name, data, valid)
            start = time.perf_counter()
            try:
                with silence_stderr():
                    for frame in open_source(folder):
                        assert np.isfinite(frame.depth).all()
                counts["read"] += 1
            except ObjectflowError:
                counts["refused"] += 1
            except Exception:
                traceback.print_exc()
                print(f"input {number}: {name}: {data[:300]!r}")
                return 1
            slowest = max(slowest, (time.perf_counter() - start, name))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{arguments.count} inputs: {counts['read']} read, {counts['refused']} refused")
    print(f"slowest {slowest[0]:.2f} s ({slowest[1]}); peak memory {memory:.0f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
