"""Sets that can be evaluated: pairs, sequences used in two ways, and errors for everything else."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from helpers import small_sets
from helpers.pair_sets import write_part
from objectflow.errors import DatasetError
from objectflow.evaluation.data.sources import SequenceUse, open_set


def test_pairs(tmp_path: Path) -> None:
    pairs = open_set(str(small_sets.write_box_pairs(tmp_path / "set", 3)))
    assert (pairs.data, pairs.kind, pairs.split) == ("set", "pairs", "test")
    assert pairs.keys == ("test-000000", "test-000001", "test-000002")
    assert pairs.window(pairs.keys[0]) is None
    truth = pairs.pair("test-000001").truth
    assert truth.moving == {1}
    # 60 frames at 1 mm each; the flow points back to the left.
    flow = truth.scene_flow[truth.labels == 1]
    assert flow == pytest.approx(np.tile([-0.06, 0, 0], (len(flow), 1)), abs=1e-6)
    with pytest.raises(DatasetError, match="no pair 'x'"):
        pairs.pair("x")


def test_the_hash_depends_on_the_content_not_on_the_folder(tmp_path: Path) -> None:
    first = small_sets.write_box_pairs(tmp_path / "a", 2)
    before = open_set(str(first)).sha256
    shutil.copytree(first, tmp_path / "b" / "c")
    assert open_set(str(tmp_path / "b" / "c")).sha256 == before
    small_sets.write_sequences(first)  # another part has no effect
    assert open_set(str(first)).sha256 == before
    assert open_set(str(small_sets.write_box_pairs(tmp_path / "d", 2, seed=9))).sha256 != before


@pytest.mark.parametrize(
    ("use", "kind", "keys", "prev", "curr", "moved"),
    [
        ("paper", "sequences", ["test-000000/80", "test-000001/80"], 0, 6, 0.06),
        ("consecutive", "consecutive", [f"test-00000{s}/{f}" for s in (0, 1) for f in range(30, 91, 10)], 4, 5, 0.01),
    ],
)
def test_sequences(
    use: SequenceUse, kind: str, keys: list[str], prev: int, curr: int, moved: float, tmp_path: Path
) -> None:
    folder = small_sets.write_sequences(tmp_path / "set")
    pairs = open_set(str(folder), sequences=use)
    assert (pairs.kind, list(pairs.keys)) == (kind, keys)
    key = keys[1] if use == "paper" else "test-000001/70"
    pair, window = pairs.pair(key), pairs.window(key)
    assert window is not None
    assert (len(window.frames), window.prev, window.curr) == (8, prev, curr)
    assert np.array_equal(window.frames[window.prev].color, pair.prev.color)
    assert np.array_equal(window.frames[window.curr].color, pair.curr.color)
    assert pair.truth.scene == "test-000001"
    flow = pair.truth.scene_flow[pair.truth.labels == 1]
    assert flow == pytest.approx(np.tile([-moved, 0, 0], (len(flow), 1)), abs=1e-6)
    with pytest.raises(DatasetError, match="no pair 'x/80'"):
        pairs.pair("x/80")


def test_sequences_without_the_papers_frames_can_be_taken_consecutively(tmp_path: Path) -> None:
    folder = small_sets.write_sequences(tmp_path / "set", frames=(0, 1, 2))
    with pytest.raises(DatasetError, match=r"frames \[0, 1, 2\], not both of \(20, 80\): use --consecutive"):
        open_set(str(folder), sequences="paper")
    assert len(open_set(str(folder), sequences="consecutive").keys) == 4


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ("{0}/none", {}, "no such folder"),
        ("{0}", {}, "no manifest.json"),
        ("{0}/set", {"split": "val"}, "no pairs of split 'val'; there is: test"),
        ("{0}/set", {"sequences": "paper"}, "no sequences of split 'test'"),
        ("{0}/set", {"translation_only": ["ball"]}, "--translation-only is for real pairs"),
        ("real:{0}", {}, "no pair folders in it"),
        ("real:{0}/none", {}, "no such folder"),
        ("real:{0}", {"sequences": "paper"}, "pair folders hold no sequences"),
        ("tiny", {"split": "train"}, "no pairs of split 'train'"),
    ],
)
def test_data_that_is_not_a_set_is_refused(data: str, options: dict[str, str], message: str, tmp_path: Path) -> None:
    small_sets.write_box_pairs(tmp_path / "set", 1)
    with pytest.raises(DatasetError, match=message):
        open_set(data.format(tmp_path), **options)  # type: ignore[arg-type]


def test_an_empty_set_says_so(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="split 'test' has no pairs"):
        open_set(str(write_part(tmp_path / "set", "pairs", [], "test")))


def test_folders_of_pairs_ask_for_their_name(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "camera.json").write_text("{}")
    with pytest.raises(DatasetError, match=f"name it real:{tmp_path}"):
        open_set(str(tmp_path))
