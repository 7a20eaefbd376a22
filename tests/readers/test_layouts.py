"""Folders of TUM and of numbered frames: frames, cameras, units and notes."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from helpers.layout_files import HEIGHT, OPTIONS, WIDTH, check_frames, color, depth, write, write_frames
from objectflow.errors import ReaderError
from objectflow.readers import CameraOptions, open_source

# --- TUM ---


def write_tum(folder: Path, lines: dict[str, str], units: int = 5000, encoding: str = "utf-8") -> None:
    write_frames(folder, "rgb/{}.png", "depth/{}.png", units=units)
    for name, text in lines.items():
        (folder / name).write_bytes(text.encode(encoding))


@pytest.mark.parametrize(
    ("form", "encoding"),
    [
        ("# a comment\n{t:.6f} {f}\n", "utf-8"),
        ("{t:.6f} {f}\r\n", "utf-8-sig"),
        ("{t:.6f},{f}\n", "utf-8"),
        ("{t:.6f}, {f}\r\n", "utf-16"),
        ("{t:.6f}\t./{f}\n", "utf-8"),
    ],
)
def test_lists_as_editors_and_spreadsheets_write_them(tmp_path: Path, form: str, encoding: str) -> None:
    lists = {
        f"{kind}.txt": "".join(form.format(t=100 + 0.3 * k, f=f"{kind}/{k}.png") for k in range(4))
        for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists, encoding=encoding)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert [source.timestamp(k) for k in range(4)] == pytest.approx([100, 100.3, 100.6, 100.9])
    assert source.notes == ()


@pytest.mark.parametrize("per_second", [10**3, 10**6, 10**9])
def test_whole_stamps_in_smaller_units(tmp_path: Path, per_second: int) -> None:
    start = 1403636579
    lists = {
        f"{kind}.txt": "".join(f"{start * per_second + k * per_second // 10} {kind}/{k}.png\n" for k in range(4))
        for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(3) == pytest.approx(start + 0.3, abs=1e-3)
    assert any("not in seconds" in note for note in source.notes)


def test_no_pair_crosses_a_clock_that_was_set_back(tmp_path: Path) -> None:
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", count=12, units=5000)
    stamps = [200 + 0.1 * k for k in range(6)] + [50 + 0.1 * k for k in range(6)]
    for kind in ("rgb", "depth"):
        text = "".join(f"{stamp:.3f} {kind}/{k}.png\n" for k, stamp in enumerate(stamps))
        (tmp_path / f"{kind}.txt").write_text(text)
    source = open_source(tmp_path, OPTIONS)
    check_frames(source, 12)
    assert source.cuts == (6,)
    assert any("goes back" in note for note in source.notes)


def test_an_unordered_list_is_sorted(tmp_path: Path) -> None:
    order = [3, 0, 2, 1]
    lists = {
        f"{kind}.txt": "".join(f"{100 + 0.1 * k:.1f} {kind}/{k}.png\n" for k in order) for kind in ("rgb", "depth")
    }
    write_tum(tmp_path, lists)
    check_frames(open_source(tmp_path, OPTIONS))


def test_depth_that_lags_is_paired_with_max_lag(tmp_path: Path) -> None:
    lists = {
        "rgb.txt": "".join(f"{100 + 0.1 * k:.3f} rgb/{k}.png\n" for k in range(4)),
        "depth.txt": "".join(f"{100.035 + 0.1 * k:.3f} depth/{k}.png\n" for k in range(4)),
    }
    write_tum(tmp_path, lists)
    with pytest.raises(ReaderError, match=r"within 0.02 s.*--max-lag 0.04 admits it"):
        open_source(tmp_path, OPTIONS)
    check_frames(open_source(tmp_path, CameraOptions(intrinsics=OPTIONS.intrinsics, max_lag=0.04)))


@pytest.mark.parametrize("line", ["{t} depth/{k}.png {t} rgb/{k}.png", "{t},rgb/{k}.png,{t},depth/{k}.png"])
@pytest.mark.parametrize("times", [[0, 1, 2, 3], [100.1, 100.2, 100.3, 100.4]])
def test_associations_name_colour_and_depth_in_either_order(tmp_path: Path, line: str, times: list[float]) -> None:
    lines = "\n".join(line.format(t=t, k=k) for k, t in enumerate(times))
    write_tum(tmp_path, {"associations.txt": lines})
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.depth_scale == 5000
    assert "5000 depth units per metre" in " ".join(source.notes)
    # Frame numbers are no times.
    assert source.timestamp(1) == (None if times[0] == 0 else 100.2)


@pytest.mark.parametrize("name", ["../x.png", "/etc/hostname", "rgb/../../x.png", "..\\x.png"])
@pytest.mark.parametrize("layout", ["lists", "associations"])
def test_lists_stay_inside_their_folder(tmp_path: Path, name: str, layout: str) -> None:
    folder = tmp_path / "set"
    write(tmp_path / "x.png", color(1))
    lists = {"rgb.txt": f"1.0 rgb/0.png\n1.1 {name}\n", "depth.txt": "1.0 depth/0.png\n1.1 depth/1.png\n"}
    if layout == "associations":
        lists = {"associations.txt": f"1.0 rgb/0.png 1.0 depth/0.png\n1.1 {name} 1.1 depth/1.png\n"}
    write_tum(folder, lists)
    with pytest.raises(ReaderError, match=r"line 2: .* lies outside the folder"):
        open_source(folder, OPTIONS)


def test_missing_empty_and_special_files_are_named_and_left_in_place(tmp_path: Path) -> None:
    lists = {f"{kind}.txt": "".join(f"{100 + k} {kind}/{k}.png\n" for k in range(8)) for kind in ("rgb", "depth")}
    write_frames(tmp_path, "rgb/{}.png", "depth/{}.png", count=8, units=5000)
    for name, text in lists.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "rgb/0.png").unlink()
    (tmp_path / "depth/2.png").write_bytes(b"")
    (tmp_path / "depth/4.png").unlink()
    os.mkfifo(tmp_path / "depth/4.png")
    (tmp_path / "depth/6.png").unlink()
    (tmp_path / "depth/6.png").symlink_to("/dev/zero")
    source = open_source(tmp_path, OPTIONS)
    assert len(source) == 8
    (note,) = source.notes
    assert note.startswith("4 of 8 frames cannot be read and are left out (")
    assert "rgb/0.png: no such file" in note
    for index in (0, 2, 4, 6):
        with pytest.raises(ReaderError):
            source[index]
    assert source[7].color[0, 0, 0] == 17


# --- numbered frames ---


def test_one_image_more_is_left_out_and_named(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{}.png", "depth/{}.png")
    write(tmp_path / "color" / "4.png", color(9))
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.notes == ("1 colour image without a depth image left out: color/4.png",)


@pytest.mark.parametrize(
    ("color_name", "depth_name"),
    [
        ("rgb/frame_{:04d}_640x480.png", "depth/frame_{:04d}_640x480.png"),
        ("RGB/cam2_{:04d}_v3.png", "Depth/cam2_{:04d}_v3.png"),
        ("color/20240501_12000{}_7.png", "depth/20240501_12000{}_7.png"),
        ("color_1280x720_{:04d}.png", "depth_640x480_{:04d}.png"),
    ],
)
def test_names_with_sizes_and_several_numbers(tmp_path: Path, color_name: str, depth_name: str) -> None:
    write_frames(tmp_path, color_name, depth_name)
    check_frames(open_source(tmp_path, OPTIONS))


@pytest.mark.parametrize("stamp", ["13050311{:02d}.250000", "13050311{:02d}250000000", "13050311{:02d}_250000000"])
def test_stamps_in_names_give_times(tmp_path: Path, stamp: str) -> None:
    write_frames(tmp_path, f"rgb/{stamp}.png", f"depth/{stamp}.png")
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(2) == pytest.approx(1305031102.25)


def test_stamps_that_differ_are_paired_by_time(tmp_path: Path) -> None:
    for k in range(4):
        write(tmp_path / f"rgb/{1305031100 + 0.1 * k:.6f}.png", color(10 + k))
        write(tmp_path / f"depth/{1305031100.008 + 0.1 * k:.6f}.png", depth(1000 + 100 * k))
    source = open_source(tmp_path, OPTIONS)
    check_frames(source)
    assert source.timestamp(3) == pytest.approx(1305031100.3)


def test_depth_of_half_the_size_is_brought_to_colour(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"color/{k}.png", color(k))
        image = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) + 1000
        write(tmp_path / f"depth/{k}.png", image)
    source = open_source(tmp_path, OPTIONS)
    np.testing.assert_allclose(source[0].depth, np.kron(image, np.ones((2, 2))) / 1000, rtol=1e-6)
    assert "depth is 16x12, colour 32x24" in source.notes[0]
    for k in range(2):
        write(tmp_path / f"depth/{k}.png", depth(1000, 16, 16))
    with pytest.raises(ReaderError, match="register the depth"):
        open_source(tmp_path, OPTIONS)


def test_a_frame_of_another_size_is_left_out(tmp_path: Path) -> None:
    write_frames(tmp_path, "color/{}.png", "depth/{}.png")
    write(tmp_path / "color/1.png", color(1, 16, 12))
    write(tmp_path / "depth/1.png", depth(1000, 16, 12))
    source = open_source(tmp_path, OPTIONS)
    assert "1 of 4 frames cannot be read" in source.notes[0]


@pytest.mark.parametrize(("suffix", "scale"), [("png", 1000), ("PNG", 1000), ("tiff", 1), ("npy", 1)])
def test_depth_formats_of_folders_and_pairs(tmp_path: Path, suffix: str, scale: int) -> None:
    for layout, names in (
        ("folder", ("color/{}.JPG", "depth/{}." + suffix)),
        ("pair", ("color{}.BMP", "depth{}." + suffix)),
    ):
        for k in range(2):
            path = tmp_path / layout / names[1].format(k)
            path.parent.mkdir(parents=True, exist_ok=True)
            metres = np.full((HEIGHT, WIDTH), 1.25 + k, np.float32)
            ok, data = cv2.imencode(names[0][-4:].lower(), color(k))
            assert ok
            target = tmp_path / layout / names[0].format(k)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data.tobytes())
            if suffix == "npy":
                np.save(path, metres)
            elif suffix == "tiff":
                tifffile.imwrite(path, metres)
            else:
                path.write_bytes(cv2.imencode(".png", (metres * 1000).astype(np.uint16))[1].tobytes())
        source = open_source(tmp_path / layout, OPTIONS)
        assert len(source) == 2
        np.testing.assert_allclose(source[1].depth, 2.25)
        scaled = open_source(tmp_path / layout, CameraOptions(intrinsics=OPTIONS.intrinsics, depth_scale=2 * scale))
        np.testing.assert_allclose(scaled[1].depth, 1.125)


def test_values_that_mark_missing_depth_and_the_largest_depth(tmp_path: Path) -> None:
    for k in range(2):
        write(tmp_path / f"color{k}.png", color(k))
        image = depth(1000)
        image[0], image[1] = 65535, 9000
        write(tmp_path / f"depth{k}.png", image)
    frame = open_source(tmp_path, OPTIONS)[0]
    assert (frame.depth[0] == 0).all()
    assert (frame.depth[1] == 9).all()
    limited = open_source(tmp_path, CameraOptions(intrinsics=OPTIONS.intrinsics, max_depth=5))[0]
    assert (limited.depth[:2] == 0).all()
