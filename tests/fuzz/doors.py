"""Every door through which data of others enters: a valid input, its mutations, and the calls that read it."""

from __future__ import annotations

import copy
import io
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fuzz import mutations
from helpers.pair_sets import random_pair, write_pairs
from helpers.small_networks import save, save_rigid
from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion
from objectflow.dataset.manifest import Manifest, verify
from objectflow.dataset.records import RecordReader
from objectflow.dataset.shards import open_pairs, open_sequences, read_metadata, write_shard
from objectflow.evaluation.cache import encode, read_prediction
from objectflow.evaluation.data.truth import truth_of_row
from objectflow.networks.sceneflownet.backbone import Trunk, load_backbone
from objectflow.networks.weights import load_network
from objectflow.readers import open_source
from objectflow.storage import files
from objectflow.storage.image_files import read_color, read_depth, read_size
from objectflow.storage.images import encode_png

Read = Callable[[], object]
Door = Callable[[random.Random, Path], Read | None]
"""Writes a mutated input into an empty folder and returns the calls that read it; None if it has none."""

CAMERA = Camera(width=16, height=12, fx=16.0, fy=16.0, cx=8.0, cy=6.0)
CAMERA_FILE = {**CAMERA.to_dict(), "depth_scale": 1000}


def color(seed: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(0, 256, (12, 16, 3), dtype=np.uint8)


def depth(seed: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(seed).integers(500, 2000, (12, 16), dtype=np.uint16)


def frames_of(path: Path) -> Read:
    def read() -> None:
        source = open_source(path)
        for index in range(min(len(source), 5)):
            source.timestamp(index)
            source[index]

    return read


def camera_files(rng: random.Random, folder: Path) -> Read:
    values = mutations.value_of(rng, CAMERA_FILE)
    data = json.dumps(values).encode()
    (folder / "camera.json").write_bytes(mutations.bytes_of(rng, data) if rng.random() < 0.3 else data)
    _pair(folder)
    return frames_of(folder)


def images(rng: random.Random, folder: Path) -> Read:
    import cv2

    suffix = rng.choice((".png", ".png", ".jpg", ".tiff", ".bmp", ".webp", ".ppm", ".pfm", ".npy", ".npz", ".exr"))
    image: np.ndarray[Any, Any] = color(0) if rng.random() < 0.5 else depth(0)
    if suffix in (".pfm", ".exr"):
        image = depth(0).astype(np.float32)
    if suffix == ".exr":
        return _exr(rng, folder, image)
    if suffix in (".npy", ".npz"):
        buffer = io.BytesIO()
        (np.save if suffix == ".npy" else np.savez_compressed)(buffer, image)
        data = buffer.getvalue()
    else:
        if suffix in (".jpg", ".bmp", ".webp"):
            image = image.astype(np.uint8)
        done, encoded = cv2.imencode(suffix if suffix != ".ppm" or image.ndim == 3 else ".pgm", image)
        data = encoded.tobytes() if done else b""
    path = folder / f"image{suffix}"
    path.write_bytes(mutations.bytes_of(rng, data))
    return _all(lambda: read_size(path), lambda: read_color(path), lambda: read_depth(path))


def tum_lists(rng: random.Random, folder: Path) -> Read:
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir()
        for index in range(3):
            image = color(index) if kind == "rgb" else depth(index)
            (folder / kind / f"{index}.png").write_bytes(encode_png(image))
    (folder / "camera.json").write_text(json.dumps(CAMERA_FILE))
    changed = rng.choice(("rgb", "depth"))
    for kind in ("rgb", "depth"):
        text = "\n".join(
            ["# timestamp filename", *(f"{10 + index / 30:.6f} {kind}/{index}.png" for index in range(3))]
        )
        text = mutations.lines_of(rng, text) if kind == changed else text
        (folder / f"{kind}.txt").write_bytes(text.encode("utf-8", "surrogatepass"))
    return frames_of(folder)


def folders(rng: random.Random, folder: Path) -> Read:
    names = [f"{kind}{rng.choice(('', '_', '/'))}{index:04d}.png" for index in range(2) for kind in ("color", "depth")]
    for index, name in enumerate(names):
        path = folder / rng.choice((name, name, name, name.upper(), f"x{name}", name.replace("0", "٣")))
        path.parent.mkdir(exist_ok=True)
        data = encode_png(color(index) if index % 2 == 0 else depth(index))
        path.write_bytes(mutations.bytes_of(rng, data) if rng.random() < 0.2 else data)
    if rng.random() < 0.9:
        (folder / rng.choice(("camera.json", "intrinsics.txt", "camera-intrinsics.txt"))).write_bytes(
            mutations.bytes_of(rng, json.dumps(CAMERA_FILE).encode())
            if rng.random() < 0.5
            else json.dumps(CAMERA_FILE).encode()
        )
    return frames_of(folder)


def results(rng: random.Random, folder: Path) -> Read:
    labels = np.random.default_rng(2).integers(0, 2, (12, 16), dtype=np.int32)
    obj = ObjectMotion(1, int(labels.sum()), 0.5, True, np.array([0.0, 0.1, 0.7]), np.eye(4))
    flow = np.random.default_rng(3).normal(size=(12, 16, 3)).astype(np.float32)
    path = folder / "result"
    SceneMotion(labels, flow, (obj,), np.eye(4), "made up", 0.5).save(path)
    if rng.random() < 0.6:
        values = json.loads((path / "objects.json").read_text())
        (path / "objects.json").write_text(json.dumps(mutations.value_of(rng, values)))
    else:
        file = path / rng.choice(("objects.json", "labels.png", "scene_flow.npy"))
        file.write_bytes(mutations.bytes_of(rng, file.read_bytes()))
    return lambda: _use(SceneMotion.load(path))


def predictions(rng: random.Random, folder: Path) -> Read:
    labels = np.random.default_rng(2).integers(0, 2, (12, 16), dtype=np.int32)
    obj = ObjectMotion(1, int(labels.sum()), 0.5, True, np.array([0.0, 0.1, 0.7]), np.eye(4))
    flow = np.random.default_rng(3).normal(size=(12, 16, 3), scale=0.1).astype(np.float32)
    data = encode(SceneMotion(labels, flow, (obj,), np.eye(4), "m", 0.5), key="a", cold=True, machine="m")
    path = folder / "a.npz"
    if rng.random() < 0.5:
        path.write_bytes(mutations.bytes_of(rng, data))
    else:
        with np.load(io.BytesIO(data)) as file:
            arrays = {name: file[name] for name in file.files}
        name = rng.choice(list(arrays))
        arrays[name] = _odd_array(rng, arrays[name])
        with open(path, "wb") as out:
            np.savez_compressed(out, **arrays)
    return lambda: _use(read_prediction(path).motion)


def weights(rng: random.Random, folder: Path) -> Read:
    path = folder / "network.safetensors"
    data = _cached(rng.choice(("scene", "rigid")))
    length = int.from_bytes(data[:8], "little")
    if rng.random() < 0.3:
        path.write_bytes(mutations.bytes_of(rng, data))
    else:
        header = json.loads(data[8 : 8 + length])
        inner = json.loads(header["__metadata__"]["objectflow"])
        part = rng.choice(("network", "network", "network", None))
        if part is None:
            inner = mutations.value_of(rng, inner)
        else:
            inner[part] = mutations.value_of(rng, inner[part])
        header["__metadata__"]["objectflow"] = json.dumps(inner)
        text = json.dumps(header).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + data[8 + length :])
    return lambda: load_network(path)


def torch_files(rng: random.Random, folder: Path) -> Read:
    path = folder / rng.choice(("trunk.pth", "trunk.pth", "trunk.pth", "trunk.safetensors"))
    trunk = Trunk(8, (1, 1))
    if path.suffix == ".pth":
        buffer = io.BytesIO()
        torch.save(trunk.state_dict(), buffer, _use_new_zipfile_serialization=rng.random() < 0.5)
        data = buffer.getvalue()
    else:
        import safetensors.torch

        data = safetensors.torch.save(trunk.state_dict())
    path.write_bytes(mutations.bytes_of(rng, data))
    return lambda: load_backbone(trunk, path)


def parquet_bytes(rng: random.Random, folder: Path) -> Read:
    _copy_set(folder / "set")
    path = next((folder / "set").glob("*.parquet"))
    path.write_bytes(mutations.bytes_of(rng, path.read_bytes()))
    _describe(folder / "set", path)
    return rows_of(folder / "set")


def parquet_rows(rng: random.Random, folder: Path) -> Read | None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    _copy_set(folder / "set")
    path = next((folder / "set").glob("*.parquet"))
    rows = copy.deepcopy(_ROWS)
    row = rng.randrange(len(rows))
    name = rng.choice(list(rows[row]))
    if isinstance(rows[row][name], bytes) and rng.random() < 0.8:
        rows[row][name] = mutations.bytes_of(rng, rows[row][name])
    else:
        rows[row][name] = mutations.value_of(rng, rows[row][name]) if rng.random() < 0.8 else mutations.hostile(rng)
    try:
        if rng.random() < 0.7:
            write_shard(path, rows, "pairs", {})
        else:  # other column types than ours
            pq.write_table(pa.Table.from_pylist(rows), path, row_group_size=8)
    except (pa.ArrowException, TypeError, ValueError, OverflowError):
        return None
    _describe(folder / "set", path)
    return rows_of(folder / "set")


def manifests(rng: random.Random, folder: Path) -> Read:
    _copy_set(folder / "set")
    path = folder / "set" / "manifest.json"
    if rng.random() < 0.2:
        path.write_bytes(mutations.bytes_of(rng, path.read_bytes()))
    else:
        path.write_text(json.dumps(mutations.value_of(rng, json.loads(path.read_text()))))
    check = rows_of(folder / "set")
    return _all(lambda: verify(folder / "set", Manifest.read(folder / "set")), check)


def arguments(rng: random.Random, folder: Path) -> Read:
    """Wrong-typed arguments of cameras and frames, which are not files."""
    del folder
    odd = [mutations.hostile(rng), np.timedelta64(3, "s"), np.longdouble("1e4000"), 10**80, np.array([1, 2]), b"1", 1j]
    name = rng.choice(list(CAMERA.to_dict()))
    values = {**CAMERA.to_dict(), name: rng.choice(odd)}
    frame = RgbdFrame(color(0), depth(0).astype(np.float32) / 1000, CAMERA)
    fields: dict[str, Any] = {"color": frame.color, "depth": frame.depth, "camera": CAMERA}
    fields[rng.choice(("color", "depth", "camera", "timestamp", "name", "depth_scale"))] = rng.choice(odd)
    one, two = rng.choice(odd), rng.choice([*odd, 48])
    return _all(
        lambda: Camera(**values),
        lambda: frame.resized(one, two),
        lambda: frame.downscaled_to_width(one),
        lambda: CAMERA.scaled(two, one),
        lambda: CAMERA.cropped(one, two, 4, 4),
        lambda: RgbdFrame(**fields),
    )


def _all(*calls: Read) -> Read:
    """Make every call, whether or not the calls before it raised one of our errors."""
    from objectflow.errors import ObjectflowError

    def read() -> None:
        last: ObjectflowError | None = None
        for call in calls:
            try:
                call()
            except ObjectflowError as error:
                last = error
        if last is not None:
            raise last

    return read


def _use(motion: SceneMotion) -> None:
    for obj in motion.objects:
        obj.to_dict()
    repr(motion)
    motion.to_coco()


def _pair(folder: Path) -> None:
    for index in (0, 1):
        (folder / f"color{index}.png").write_bytes(encode_png(color(index)))
        (folder / f"depth{index}.png").write_bytes(encode_png(depth(index)))


def _exr(rng: random.Random, folder: Path, image: np.ndarray[Any, Any]) -> Read:
    import OpenEXR

    path = folder / "image.exr"
    channels = {"Z": image if image.ndim == 2 else image[..., 0].copy()}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    path.write_bytes(mutations.bytes_of(rng, path.read_bytes()))
    return _all(lambda: read_size(path), lambda: read_depth(path))


def _odd_array(rng: random.Random, array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    kind = rng.randrange(6)
    if kind == 0:
        kinds = ("f2", "f8", "i8", "u1", "S5", "U5", "?", "c8") if array.dtype.kind != "U" else ("S5", "U2")
        return array.astype(rng.choice(kinds))
    if kind == 1:
        return array.reshape(-1)[: rng.choice((0, 1, 3))]
    if kind == 2:
        return np.full_like(array, rng.choice((0, 1, 255)))
    if kind == 3 and array.dtype.kind == "f":
        return np.full_like(array, rng.choice((np.nan, np.inf, -1e308)))
    if kind == 4:
        return array[None]
    return np.array(rng.choice(("text", 5, -1, 1e400)))


_CACHE: dict[str, bytes] = {}
_ROWS: list[dict[str, Any]] = []


def _cached(name: str) -> bytes:
    return _CACHE[name]


def prepare(folder: Path) -> None:
    """Make the valid inputs that are slow to make."""
    _CACHE["scene"] = save(folder / "scene.safetensors").read_bytes()
    _CACHE["rigid"] = save_rigid(folder / "rigid.safetensors").read_bytes()
    pairs = [random_pair(number, objects=2, camera=CAMERA) for number in range(3)]
    _ROWS[:] = [pair.to_dict() for pair in pairs]
    write_pairs(folder / "set", pairs)
    for path in (folder / "set").iterdir():
        _CACHE[path.name] = path.read_bytes()


def _copy_set(folder: Path) -> None:
    folder.mkdir()
    for name, data in _CACHE.items():
        if name.endswith((".parquet", ".json")):
            (folder / name).write_bytes(data)


def _describe(folder: Path, path: Path) -> None:
    """Make the manifest fit a changed shard."""
    values = json.loads((folder / "manifest.json").read_text())
    shard = values["parts"]["train"]["shards"][0]
    shard["bytes"], shard["sha256"] = path.stat().st_size, files.hash_file(path)
    (folder / "manifest.json").write_text(json.dumps(values))


def rows_of(folder: Path) -> Read:
    def pairs() -> None:
        rows = open_pairs(folder)
        _all(
            rows.keys,
            rows.count_objects,
            *(lambda i=i: truth_of_row(rows[i]) for i in range(min(3, len(rows)))),
            lambda: RecordReader(rows, (12, 16), 0, exact=False).read([0, 1, 2][: len(rows)]),
        )()

    def sequences() -> None:
        rows = open_sequences(folder)
        _all(rows.keys, lambda: rows[0])()

    return _all(pairs, sequences, *(lambda path=path: read_metadata(path) for path in folder.glob("*.parquet")))


def wipe(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


DOORS: dict[str, Door] = {
    "camera-files": camera_files,
    "images": images,
    "tum-lists": tum_lists,
    "folders": folders,
    "results": results,
    "predictions": predictions,
    "weights": weights,
    "torch-files": torch_files,
    "parquet-bytes": parquet_bytes,
    "parquet-rows": parquet_rows,
    "manifests": manifests,
    "arguments": arguments,
}
