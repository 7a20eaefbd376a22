"""Bags of several files, splits, unfinished and compressed ones, and their times."""

from __future__ import annotations

import bz2
import gzip
import sqlite3
import struct
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from helpers.bags import BagBuilder, Kind, write_frames
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.readers import CutOffWarning, FrameSource, open_source
from objectflow.readers.bag_records import decompress

CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 24.0)
PERIOD = 0.1


def frames(count: int) -> list[RgbdFrame]:
    """Frames whose colour and depth hold their number."""
    return [
        RgbdFrame(np.full((48, 64, 3), 10 * k, np.uint8), np.full((48, 64), 1 + 0.1 * k, np.float32), CAMERA)
        for k in range(count)
    ]


def check(source: FrameSource, numbers: list[int]) -> None:
    """Check which frames a source holds, in order."""
    assert [frame.color[0, 0, 0] // 10 for frame in source] == numbers
    np.testing.assert_allclose([frame.depth[0, 0] for frame in source], [1 + 0.1 * k for k in numbers], atol=1e-3)


def file_of(path: Path) -> Path:
    """The storage file of a bag."""
    return path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")


def split(tmp_path: Path, kind: Kind, names: tuple[str, ...]) -> Path:
    """A folder with four frames in two files, without metadata."""
    folder = tmp_path / "split"
    folder.mkdir()
    for number, name in enumerate(names):
        whole = tmp_path / f"part{number}{'.bag' if kind == 'ros1' else ''}"
        part = write_frames(whole, frames(4)[2 * number : 2 * number + 2], kind, start=1000 + 2 * PERIOD * number)
        file_of(part).rename(folder / name)
    return folder


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_splits_without_metadata_are_one_bag(tmp_path: Path, kind: Kind) -> None:
    end = {"ros1": ".bag", "sqlite3": ".db3", "mcap": ".mcap"}[kind]
    check(open_source(split(tmp_path, kind, (f"rec_9{end}", f"rec_10{end}"))), [0, 1, 2, 3])


def test_a_missing_file_of_the_metadata_is_noted(tmp_path: Path) -> None:
    folder = split(tmp_path, "mcap", ("rec_0.mcap", "rec_1.mcap"))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths:\n    - rec_0.mcap\n    - rec_1.mcap\n"
        "    - rec_2.mcap\n  files: []\n"
    )
    source = open_source(folder)
    check(source, [0, 1, 2, 3])
    assert source.notes[0].startswith("rec_2.mcap of metadata.yaml is missing")


def test_an_unreadable_split_is_left_out_with_a_note(tmp_path: Path) -> None:
    folder = split(tmp_path, "mcap", ("rec_0.mcap", "rec_1.mcap"))
    (folder / "rec_1.mcap").write_bytes(b"nothing")
    source = open_source(folder)
    check(source, [0, 1])
    assert "rec_1.mcap" in source.notes[0]


def test_an_active_bag_is_read(tmp_path: Path) -> None:
    path = write_frames(tmp_path / "a.bag", frames(3), "ros1")
    data = bytearray(path.read_bytes())
    # Until a bag is closed, the position of its index is 0.
    position = data.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, position)
    data[position : position + 8] = bytes(8)
    (tmp_path / "b.bag.active").write_bytes(data[:index])
    with pytest.warns(CutOffWarning):
        source = open_source(tmp_path / "b.bag.active")
    check(source, [0, 1, 2])
    assert "cut off" in source.notes[0]


@pytest.mark.parametrize("packer", ["zst", "zstd", "gz", "bz2", "lz4"])
def test_compressed_files_are_read_and_nothing_is_left(
    tmp_path: Path, packer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(place))
    data = file_of(write_frames(tmp_path / "a", frames(3), "mcap")).read_bytes()
    pack = {"gz": gzip.compress, "bz2": bz2.compress, "lz4": lz4.frame.compress}.get(packer, zstd.compress)
    file = tmp_path / f"b.mcap.{packer}"
    file.write_bytes(pack(data))
    source = open_source(file)
    check(source, [0, 1, 2])
    del source
    assert not list(place.iterdir())
    file.write_bytes(pack(data)[: len(pack(data)) // 2])
    with pytest.raises(ReaderError, match="cannot be decompressed"):
        open_source(file)
    assert not list(place.iterdir())


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE])
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_compression_of_ros2(tmp_path: Path, mode: CompressionMode, plugin: StoragePlugin) -> None:
    if mode is CompressionMode.STORAGE and plugin is StoragePlugin.SQLITE3:
        pytest.skip("SQLite has no compression of its own")
    bag = BagBuilder("mcap")
    write_frames(tmp_path / "plain", frames(3), "mcap", bag=bag)
    writer = Writer2(tmp_path / "a", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        known = {}
        for topic, msgtype, time, message in sorted(bag.messages, key=lambda m: m[2]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=bag.store)
            writer.write(known[topic], time, bag.store.serialize_cdr(message, msgtype))
    check(open_source(tmp_path / "a"), [0, 1, 2])


@pytest.mark.parametrize("compression", [Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4])
def test_compression_of_ros1(tmp_path: Path, compression: Writer1.CompressionFormat) -> None:
    bag = BagBuilder("ros1")
    write_frames(tmp_path / "plain.bag", frames(3), "ros1", bag=bag)
    writer = Writer1(tmp_path / "a.bag")
    writer.set_compression(compression)
    with writer:
        known = {}
        for topic, msgtype, time, message in sorted(bag.messages, key=lambda m: m[2]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=bag.store)
            writer.write(known[topic], time, bag.store.serialize_ros1(message, msgtype))
    check(open_source(tmp_path / "a.bag"), [0, 1, 2])


def test_decompression_ends_at_the_stated_size() -> None:
    data = bytes(1 << 24)
    for name, pack in (("bz2", bz2.compress), ("lz4", lz4.frame.compress), ("zstd", zstd.compress)):
        assert decompress(pack(data), name, len(data)) == data
        # A chunk that holds more than it states is cut there, and one that states more is damaged.
        assert len(decompress(pack(data), name, 1000)) == 1000
        with pytest.raises(ValueError, match="ends after"):
            decompress(pack(data), name, len(data) + 1)
        with pytest.raises(ValueError, match="too large"):
            decompress(pack(data), name, 100 << 30)
    with pytest.raises(ValueError, match="not known"):
        decompress(b"", "lzo", 1)


def test_a_damaged_chunk_is_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    camera = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
    noisy = [
        RgbdFrame(
            rng.integers(0, 255, (480, 640, 3), dtype=np.uint8), np.full((480, 640), 1 + 0.1 * k, np.float32), camera
        )
        for k in range(6)
    ]
    bag = BagBuilder("ros1")
    write_frames(tmp_path / "plain.bag", noisy, "ros1", bag=bag)
    writer = Writer1(tmp_path / "a.bag")
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    with writer:
        known = {}
        for topic, msgtype, time, message in sorted(bag.messages, key=lambda m: m[2]):
            if topic not in known:
                known[topic] = writer.add_connection(topic, msgtype, typestore=bag.store)
            writer.write(known[topic], time, bag.store.serialize_ros1(message, msgtype))
    data = bytearray((tmp_path / "a.bag").read_bytes())
    second = data.index(b"compression=bz2", data.index(b"compression=bz2") + 20)
    data[second + 2000 : second + 2400] = bytes(400)
    (tmp_path / "a.bag").write_bytes(data)
    source = open_source(tmp_path / "a.bag")
    assert "cannot be decompressed" in source.notes[0]
    assert 3 <= len(source) < 6
    for frame in source:
        number = round(10 * (frame.depth[0, 0] - 1))
        np.testing.assert_array_equal(frame.color, noisy[number].color)


def test_a_damaged_database_leaves_no_files(tmp_path: Path) -> None:
    path = file_of(write_frames(tmp_path / "a", frames(3), "sqlite3"))
    before = sorted(file.name for file in path.parent.iterdir())
    check(open_source(path), [0, 1, 2])
    assert sorted(file.name for file in path.parent.iterdir()) == before
    with sqlite3.connect(path) as database:
        database.execute("DROP TABLE messages")
    with pytest.raises(ReaderError, match="not a bag that can be read"):
        open_source(path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ReaderError, match="not a bag that can be read"):
        open_source(path)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_two_recorders_and_a_clock_that_is_set_back(tmp_path: Path, kind: Kind) -> None:
    bag = BagBuilder(kind)
    write_frames(tmp_path / ("w.bag" if kind == "ros1" else "w"), frames(6), kind, bag=bag)
    doubled = BagBuilder(kind)
    # Every message twice; from frame 3 on the clock of the headers is half a second behind.
    for topic, msgtype, time, message in bag.messages:
        if time >= int((1000 + 2.5 * PERIOD) * 1e9):
            stamp = message.header.stamp
            seconds = stamp.sec + stamp.nanosec * 1e-9 - 0.5
            message.header.stamp = type(stamp)(sec=int(seconds), nanosec=round((seconds % 1) * 1e9) % 10**9)
        doubled.messages += [(topic, msgtype, time, message), (topic, msgtype, time + 10**6, message)]
    source = open_source(doubled.write(tmp_path / ("a.bag" if kind == "ros1" else "a")))
    check(source, [0, 1, 2, 3, 4, 5])
    assert source.cuts == (3,)
    assert any("6 repeated stamps" in note for note in source.notes)
    assert any("the time goes back" in note for note in source.notes)
