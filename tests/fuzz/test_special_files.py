"""Files that are no regular files, and values beyond those of the mutations, at each door."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fuzz.harness import judged
from objectflow import Camera, SceneMotion
from objectflow.cli.run_folder import open_run_source, read_tracks
from objectflow.dataset.manifest import Manifest
from objectflow.errors import DatasetError, ObjectflowError, ReaderError, ResultError
from objectflow.evaluation.results import Evaluation
from objectflow.networks.weights import load_network
from objectflow.readers import CameraOptions, open_source
from objectflow.readers.camera_files import read_camera_file
from objectflow.settings import read_toml
from objectflow.storage.image_files import read_depth, read_photograph, read_size
from objectflow.synth.objects.mesh_files import read_mesh
from objectflow.synth.scenes.textures import TextureSpec, draw_texture
from objectflow.training.run_folder import read_metrics


def texture(path: Path) -> None:
    draw_texture(TextureSpec("image", path=str(path)), 16)


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "camera": (Camera.read, "camera.json"),
    "camera file": (read_camera_file, "K.txt"),
    "results of an evaluation": (Evaluation.read, "results.json"),
    "weights": (load_network, "network.safetensors"),
    "settings of a method": (read_toml, "settings.toml"),
    "result": (lambda path: SceneMotion.load(path.parent), "objects.json"),
    "manifest": (lambda path: Manifest.read(path.parent), "manifest.json"),
    "settings of a run": (lambda path: open_run_source(path.parent, None, "--source"), "settings.json"),
    "tracks": (lambda path: read_tracks(path.parent), "tracks.json"),
    "metrics": (lambda path: read_metrics(path.parent), "metrics.jsonl"),
    "picture": (read_photograph, "picture.png"),
    "texture": (texture, "picture.png"),
}


@pytest.mark.parametrize("kind", FILES)
def test_devices_are_refused(kind: str, tmp_path: Path) -> None:
    read, name = FILES[kind]
    (tmp_path / name).symlink_to("/dev/null")  # a device that does not block, unlike a pipe or /dev/zero
    with pytest.raises(ObjectflowError, match="regular file"):
        read(tmp_path / name)


@pytest.mark.parametrize("path", ["a\0b", "\ud800", "n" * 300, "n" * 5000])
def test_impossible_paths(path: str) -> None:
    for read, _ in FILES.values():
        assert judged(partial(read, Path(path))) == []
        assert judged(partial(read, Path(path) / "file")) == []
    assert judged(lambda: open_source(path)) == []
    assert judged(lambda: CameraOptions(camera_file=Path(path)).fit((8, 6), Path(path))) == []


@pytest.mark.parametrize("intrinsics", [(1.0,), 5, ("a", 1, 1, 1), [1, 1, 1, None]])
def test_odd_options_of_a_camera(intrinsics: Any) -> None:
    with pytest.raises(ReaderError, match="four numbers"):
        CameraOptions(intrinsics=intrinsics)
    with pytest.raises(ReaderError, match="positive number"):
        CameraOptions(max_depth="1")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "settings",
    [
        "[" * 100_000,
        "5",
        '{"source": 5}',
        '{"source": "a", "options": {}}',
        '{"source": "a", "intrinsics": {"fx": 1e400}}',
        '{"source": "a", "topics": 5, "options": {}}',
        json.dumps({"source": "a", "options": {**CameraOptions().to_dict(), "intrinsics": [1]}}),
        json.dumps({"source": "a", "topics": [1, 2, 3], "options": CameraOptions().to_dict()}),
    ],
)
def test_settings_of_a_run(tmp_path: Path, settings: str) -> None:
    (tmp_path / "settings.json").write_text(settings)
    with pytest.raises(ResultError, match="not the settings of a run"):
        open_run_source(tmp_path, None, "--source")


TRACK = {"id": 1, "times": [0.0], "world_T_object": [np.eye(4).tolist()], "labels": [1], "scores": [1.0], "gaps": []}


@pytest.mark.parametrize(
    "change",
    [
        {"id": 1e999},
        {"id": "9" * 5000},
        {"times": [float("nan")]},
        {"times": []},
        {"world_T_object": [[[1]]]},
        {"world_T_object": [(np.eye(4) * np.nan).tolist()]},
        {"labels": None},
        {"scores": [None]},
    ],
)
def test_tracks(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "tracks.json"
    path.write_text(json.dumps({"tracks": [TRACK]}))
    assert [track.id for track in read_tracks(tmp_path)] == [1]
    path.write_text(json.dumps({"tracks": [{**TRACK, **change}]}))
    with pytest.raises(ResultError, match="not the tracks of a run"):
        read_tracks(tmp_path)
    path.write_text("[" * 100_000)
    with pytest.raises(ResultError, match="not the tracks of a run: nested too deeply"):
        read_tracks(tmp_path)


def test_torn_metrics(tmp_path: Path) -> None:
    line = {"kind": "train", "step": 1}
    torn = ["5", "[[1]]", '{"kind": 1}', "\0\0", "[" * 100_000, "\xff"]
    (tmp_path / "metrics.jsonl").write_bytes("\n".join([json.dumps(line), *torn]).encode("latin-1"))
    assert read_metrics(tmp_path) == [line]


RECORD3D = {"K": [10, 0, 0, 0, 10, 0, 8, 6, 1], "w": 16, "h": 12, "dw": 8, "dh": 6}
BLOCK = b"bvx-" + struct.pack("<I", 0)
"""An LZFSE block without data."""


def write_r3d(path: Path, metadata: str, names: list[str], depth: bytes = b"") -> Path:
    image = cv2.imencode(".jpg", np.zeros((12, 16, 3), np.uint8))[1].tobytes()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", metadata)
        for name in names:
            archive.writestr(name, image if name.endswith("jpg") else depth)
    return path


def test_odd_recordings_of_record3d(tmp_path: Path) -> None:
    pytest.importorskip("lzfse")
    names = [f"rgbd/{index}.{kind}" for index in (0, 1) for kind in ("jpg", "depth")]
    for stamps in (f"[1{'0' * 400}, 2]", "[NaN, 1]", '["a", 1]', "5"):
        metadata = json.dumps(RECORD3D)[:-1] + f', "frameTimestamps": {stamps}}}'
        assert open_source(write_r3d(tmp_path / "a.r3d", metadata, names)).timestamp(0) is None
    many = [f"rgbd/{'9' * 5000}.jpg", f"rgbd/{'9' * 5000}.depth", "rgbd/1.jpg"]
    with pytest.raises(ReaderError, match="0 frames"):
        open_source(write_r3d(tmp_path / "a.r3d", json.dumps(RECORD3D), many))
    source = open_source(write_r3d(tmp_path / "a.r3d", json.dumps(RECORD3D), names, BLOCK * 100_000))
    with pytest.raises(ReaderError, match="LZFSE blocks"):
        source[0]


def test_small_files_of_images_that_need_gigabytes(tmp_path: Path) -> None:
    """Images of 60 megapixels with 32 bytes each, of which only the headers are here."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"shape": (7500, 8000, 4), "fortran_order": False, "descr": np.dtype(np.float64).str}
    )
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("depth.npy", b"\x93NUMPY\x01\x00" + header.getvalue().removeprefix(b"\x93NUMPY\x01\x00"))
    # Width, height, bits of each sample, and samples of each pixel.
    tags = [(256, 8000), (257, 7500), (258, 64), (277, 4)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    (tmp_path / "a.tiff").write_bytes(struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4))
    for name in ("a.npz", "a.tiff"):
        for read in (read_size, read_depth):
            with pytest.raises(ReaderError, match="too large for an image"):
                read(tmp_path / name)


def test_odd_meshes_and_textures(tmp_path: Path) -> None:
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
    (tmp_path / "huge.pgm").write_bytes(b"P5 20000 20000 255\n" + bytes(100))
    with pytest.raises(DatasetError, match=r"cannot read the texture .*huge\.pgm: .*too many"):
        texture(tmp_path / "huge.pgm")
    for number, (library, material) in enumerate(
        [("a.mtl", "newmtl a\nKd x y z\n"), ("a.mtl", "newmtl a\nmap_Kd \n"), ("", "")]
    ):
        (tmp_path / "a.mtl").write_text(material)
        path = tmp_path / f"{number}.obj"
        path.write_text(f"mtllib {library}\n{triangle}")
        assert judged(partial(read_mesh, path)) == []
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd huge.pgm\n")
    (tmp_path / "b.obj").write_text(f"mtllib a.mtl\n{triangle}")
    assert len(read_mesh(tmp_path / "b.obj").faces) == 1  # usable without its texture
