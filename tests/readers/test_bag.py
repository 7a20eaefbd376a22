"""Bags written by rosbags and read back: frames, topics, times and broken bags."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

import analytic
from helpers.bags import COLOR, DEPTH, INFO, BagBuilder, Kind, compressed_depth, write_frames
from objectflow.cli import main
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.readers import CameraOptions, CutOffWarning, open_source

KINDS: tuple[Kind, ...] = get_args(Kind)
CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.0)


def frames(count: int) -> list[RgbdFrame]:
    """Random colours on a wall that approaches by 5 cm per frame."""
    rng = np.random.default_rng(1)
    out = []
    for number in range(count):
        depth = np.full((48, 64), 1.5 - 0.05 * number, np.float32)
        depth[:5, :7] = 0
        out.append(RgbdFrame(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8), depth, CAMERA))
    return out


def suffix(kind: Kind) -> str:
    return "table.bag" if kind == "ros1" else "table"


@pytest.mark.parametrize("kind", KINDS)
def test_frames_round_trip_through_every_kind_of_bag(tmp_path: Path, kind: Kind) -> None:
    written = frames(4)
    source = open_source(write_frames(tmp_path / suffix(kind), written, kind))
    assert len(source) == 4
    assert source.camera == CAMERA
    for number, (read, frame) in enumerate(zip(source, written, strict=True)):
        np.testing.assert_array_equal(read.color, frame.color)
        np.testing.assert_allclose(read.depth, frame.depth, atol=5e-4)
        assert read.timestamp == pytest.approx(1000 + 0.1 * number)
        assert source.timestamp(number) == read.timestamp
    # Random access, as a viewer needs it.
    np.testing.assert_array_equal(source[2].color, written[2].color)


def test_a_single_mcap_file_is_a_bag(tmp_path: Path) -> None:
    folder = write_frames(tmp_path / "table", frames(3), "mcap")
    (file,) = folder.glob("*.mcap")
    assert len(open_source(file)) == 3


@pytest.mark.parametrize("floating", [False, True])
def test_compressed_topics_are_decoded(tmp_path: Path, floating: bool) -> None:
    frame = frames(1)[0]
    bag = BagBuilder("ros1")
    done, jpeg = cv2.imencode(".png", frame.color[..., ::-1])
    assert done
    bag.compressed("/rgb/compressed", 5.0, jpeg.tobytes(), "bgr8; png compressed bgr8")
    bag.compressed("/depth/compressedDepth", 5.0, *compressed_depth(frame.depth, floating=floating))
    bag.info("/rgb/camera_info", 5.0, frame)
    (read,) = list(open_source(bag.write(tmp_path / "a.bag")))
    np.testing.assert_array_equal(read.color, frame.color)
    # Inverse depth is quantised to 0.01 per metre, which is 1.1 cm at 1.5 m.
    np.testing.assert_allclose(read.depth, frame.depth, atol=0.012 if floating else 5e-4)


@pytest.mark.parametrize("encoding", ["bgr8", "rgba8", "bgra8", "mono8", "bayer_rggb8"])
def test_colour_encodings_and_padded_rows(tmp_path: Path, encoding: str) -> None:
    frame = frames(1)[0]
    color = np.full((48, 64, 3), (200, 100, 50), np.uint8)
    stored = {
        "bgr8": color[..., ::-1],
        "rgba8": np.dstack([color, np.full((48, 64), 7, np.uint8)]),
        "bgra8": np.dstack([color[..., ::-1], np.full((48, 64), 7, np.uint8)]),
        "mono8": np.full((48, 64), 90, np.uint8),
        "bayer_rggb8": np.tile(np.array([[200, 100], [100, 50]], np.uint8), (24, 32)),
    }[encoding]
    bag = BagBuilder("mcap")
    bag.image(COLOR, 5.0, stored, encoding, pad=12)
    bag.image(DEPTH, 5.0, frame.depth, "32FC1", pad=8)
    bag.info(INFO, 5.0, frame)
    (read,) = list(open_source(bag.write(tmp_path / "a")))
    expected = np.full_like(color, 90) if encoding == "mono8" else color
    np.testing.assert_array_equal(read.color[4:-4, 4:-4], expected[4:-4, 4:-4])
    np.testing.assert_array_equal(read.depth, frame.depth)


def test_ambiguous_topics_are_listed_as_options_and_can_be_chosen(tmp_path: Path) -> None:
    frame = frames(1)[0]
    bag = BagBuilder("ros1")
    for name in ("left", "right"):
        bag.image(f"/{name}/image", 5.0, frame.color if name == "left" else frame.color[::-1], "rgb8")
    bag.image(DEPTH, 5.0, np.rint(frame.depth * 1000).astype(np.uint16), "16UC1")
    bag.info("/right/camera_info", 5.0, frame)
    path = bag.write(tmp_path / "a.bag")
    with pytest.raises(ReaderError, match="--color-topic /left/image --color-topic /right/image"):
        open_source(path)
    (read,) = list(open_source(path, color_topic="/right/image"))
    np.testing.assert_array_equal(read.color, frame.color[::-1])
    with pytest.raises(ReaderError, match="no images on /middle; colour topics: --color-topic /left/image"):
        open_source(path, color_topic="/middle")


def test_live_accepts_topics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = BagBuilder("ros1")
    for number, frame in enumerate(frames(2)):
        for name in ("left", "right"):
            bag.image(f"/{name}/image", 5.0 + number, frame.color, "rgb8")
        bag.image(DEPTH, 5.0 + number, np.rint(frame.depth * 1000).astype(np.uint16), "16UC1")
        bag.info("/right/camera_info", 5.0 + number, frame)
    command = ["live", str(bag.write(tmp_path / "a.bag")), "--method", "zero", "--speed", "10"]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert "--color-topic /left/image --color-topic /right/image" in error
    assert main([*command, "--color-topic", "/right/image"]) == 0
    assert "1 estimates" in capsys.readouterr().out


def test_the_error_for_a_realsense_recording_names_its_reader(tmp_path: Path) -> None:
    """The driver records unaligned depth, which may nevertheless have the size of colour."""
    frame = frames(1)[0]
    color, depth = (f"/device_0/sensor_{k}/{name}_0/image/data" for k, name in enumerate(("Color", "Depth")))
    bag = BagBuilder("ros1")
    bag.image(color, 5.0, frame.color, "rgb8")
    bag.image(depth, 5.0, np.rint(frame.depth * 1000).astype(np.uint16), "16UC1")
    bag.info("/device_0/sensor_0/Color_0/info/camera_info", 5.0, frame)
    path = bag.write(tmp_path / "a.bag")
    with pytest.raises(ReaderError, match="not aligned to colour: `objectflow live realsense:"):
        open_source(path)
    # Topics that are named explicitly are accepted.
    assert len(open_source(path, color_topic=color, depth_topic=depth)) == 1


def test_messages_are_paired_by_header_stamp_and_not_by_recording_time(tmp_path: Path) -> None:
    bag = BagBuilder("sqlite3")
    written = frames(3)
    for number, frame in enumerate(written):
        bag.image(COLOR, 10 + number, frame.color, "rgb8")
        bag.image(DEPTH, 10.01 + number, np.rint(frame.depth * 1000).astype(np.uint16), "16UC1")
        bag.info(INFO, 10 + number, frame)
    # Depth messages are recorded a second late, as over a slow network.
    bag.messages = [(t, k, time + (10**9 if t == DEPTH else 0), m) for t, k, time, m in bag.messages]
    for read, frame in zip(open_source(bag.write(tmp_path / "a")), written, strict=True):
        np.testing.assert_allclose(read.depth, frame.depth, atol=5e-4)


def test_errors_for_bad_bags_are_one_line(tmp_path: Path) -> None:
    frame = frames(1)[0]
    millimetres = np.rint(frame.depth * 1000).astype(np.uint16)

    def build(name: str, **parts: object) -> Path:
        bag = BagBuilder("ros1")
        if parts.get("color", True):
            bag.image(COLOR, 5.0, frame.color, "rgb8")
        if parts.get("depth", True):
            depth = millimetres if parts.get("size", 48) == 48 else millimetres[::2, ::2]
            bag.image(DEPTH, float(str(parts.get("time", 5.0))), depth, str(parts.get("encoding", "16UC1")))
        if parts.get("info", True):
            bag.info(INFO, 5.0, frame)
        return bag.write(tmp_path / f"{name}.bag")

    cases = {
        "no depth images": build("colour", depth=False),
        "no colour images": build("dark", color=False),
        r"clocks are \+95.000 s apart": build("clocks", time=100.0),
        "must be 16UC1": build("wrong", encoding="mono8"),
        "no CameraInfo for .* give --intrinsics": build("blind", info=False),
    }
    for message, path in cases.items():
        with pytest.raises(ReaderError, match=message) as caught:
            open_source(path)[0]
        assert "\n" not in str(caught.value)
    # Depth of half the size in the frame of colour is resampled to colour's pixels.
    half = open_source(build("small", size=24))
    np.testing.assert_allclose(half[0].depth[6:, 8:], frame.depth[6:, 8:], atol=5e-4)
    assert "resampled to colour's 64x48" in half.notes[0]
    camera = CameraOptions(intrinsics=(60.0, 61.0, 31.0, 24.0))
    assert open_source(tmp_path / "blind.bag", camera).camera == CAMERA
    (tmp_path / "text.bag").write_text("not a bag at all")
    with pytest.raises(ReaderError, match="not a bag that can be read"):
        open_source(tmp_path / "text.bag")
    (tmp_path / "frames").mkdir()
    with pytest.raises(ReaderError, match="topics are for bags"):
        open_source(tmp_path / "frames", color_topic="/x")


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("share", [0.35, 0.6, 0.95])
def test_the_complete_part_of_a_truncated_bag_is_read(tmp_path: Path, kind: Kind, share: float) -> None:
    # At most one chunk is lost, so the bag must be larger than a chunk.
    rng = np.random.default_rng(0)
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    written = [
        RgbdFrame(
            rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), np.full((480, 640), 1 + 0.1 * k, np.float32), camera
        )
        for k in range(8)
    ]
    path = write_frames(tmp_path / suffix(kind), written, kind)
    file = path if kind == "ros1" else next(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.warns(CutOffWarning, match="cut off in the middle"):
        source = open_source(file)
    assert share * 8 - 2.5 <= len(source) <= share * 8
    for number in range(len(source)):
        np.testing.assert_array_equal(source[number].color, written[number].color)
        np.testing.assert_allclose(source[number].depth, written[number].depth, atol=5e-4)


def test_run_follows_objects_through_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = analytic.make_scene(5)
    path = write_frames(tmp_path / "table.bag", [scene.prev, scene.curr], "ros1", period=0.5)
    assert main(["run", str(path), "--out", str(tmp_path / "out"), "--dt", "0.5"]) == 0
    assert f"{len(scene.moving)} objects followed" in capsys.readouterr().out
    lines = np.loadtxt(tmp_path / "out" / "trajectories" / "object_001.txt")
    np.testing.assert_allclose(lines[:, 0], [1000.0, 1000.5])
    assert main(["run", str(path), "--out", str(tmp_path / "far"), "--dt", "9"]) == 2
    assert "one every 9 s taken: a pair needs two" in capsys.readouterr().err
    file = path.read_bytes()
    path.write_bytes(file[: len(file) // 10])
    assert main(["run", str(path), "--out", str(tmp_path / "cut")]) == 2
    assert "not a bag that can be read" in capsys.readouterr().err
