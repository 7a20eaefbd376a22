"""TUM RGB-D directories: association by time and malformed lists."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from objectflow.errors import ReaderError
from objectflow.readers import NAMED_CAMERAS, CameraOptions, open_source
from objectflow.readers.tum import associate, read_list

times = st.lists(st.integers(0, 60).map(lambda t: t * 0.01), max_size=6, unique=True).map(sorted)


def write_tum(folder: Path, color_times: list[float], depth_times: list[float], size: tuple[int, int]) -> None:
    width, height = size
    for kind, stamps in (("rgb", color_times), ("depth", depth_times)):
        (folder / kind).mkdir(parents=True)
        lines = [f"# {kind} images", "# timestamp filename"]
        for index, stamp in enumerate(stamps):
            image = np.full((height, width, 3) if kind == "rgb" else (height, width), 10 + index, np.uint8)
            if kind == "depth":
                image = np.full((height, width), 5000 * (index + 1), np.uint16)
            cv2.imwrite(str(folder / kind / f"{stamp:.6f}.png"), image)
            lines.append(f"{stamp:.6f} {kind}/{stamp:.6f}.png")
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")


def test_nearest_depth_default_scale_and_order(tmp_path: Path) -> None:
    write_tum(tmp_path, [100.000, 100.033, 100.066, 100.500], [99.990, 100.030, 100.071], (40, 30))
    sequence = open_source(tmp_path, CameraOptions(intrinsics=(40, 40, 20, 15)))
    assert len(sequence) == 3  # the last colour image has no depth image close in time
    assert [frame.timestamp for frame in sequence] == [100.000, 100.033, 100.066]
    assert [float(frame.depth[0, 0]) for frame in sequence] == [1.0, 2.0, 3.0]


def test_a_named_camera_must_be_requested(tmp_path: Path) -> None:
    write_tum(tmp_path, [1.0], [1.0], (640, 480))
    with pytest.raises(ReaderError, match="fr1"):
        open_source(tmp_path)
    assert open_source(tmp_path, CameraOptions(camera_file=Path("fr3"))).camera == NAMED_CAMERAS["fr3"]


@pytest.mark.parametrize("line", ["abc rgb/1.png", "1.5", "nan rgb/1.png", "inf rgb/1.png", "1.5 a\x00b"])
def test_the_error_for_a_malformed_line_names_it(tmp_path: Path, line: str) -> None:
    (tmp_path / "rgb.txt").write_text(f"# comment\n1.0 rgb/a.png\n{line}\n")
    with pytest.raises(ReaderError, match="line 3"):
        read_list(tmp_path / "rgb.txt")


def test_empty_lists_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("# nothing\n")
    (tmp_path / "depth.txt").write_text("")
    with pytest.raises(ReaderError, match=r"rgb\.txt"):
        open_source(tmp_path)


@given(first=times, second=times)
@settings(max_examples=80, deadline=None)
def test_association_is_one_to_one_within_the_limit_and_maximal(first: list[float], second: list[float]) -> None:
    pairs = associate(first, second, limit=0.02)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert pairs == sorted(pairs)
    assert all(abs(first[i] - second[j]) <= 0.02 + 1e-9 for i, j in pairs)
    unpaired_first = set(range(len(first))) - {i for i, _ in pairs}
    unpaired_second = set(range(len(second))) - {j for _, j in pairs}
    assert all(abs(first[i] - second[j]) > 0.02 - 1e-9 for i, j in itertools.product(unpaired_first, unpaired_second))
    # No pair gets closer in time by exchanging one member for an unpaired time.
    for i, j in pairs:
        assert all(abs(first[i] - second[k]) >= abs(first[i] - second[j]) - 1e-9 for k in unpaired_second)
