"""Concatenated data sets: every row once, under a key that names its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.pair_sets import random_pair, write_pairs
from objectflow.dataset.batches import Batches
from objectflow.dataset.concatenated import open_joined
from objectflow.errors import DatasetError


def test_every_row_of_both_sets_comes_once_per_pass(tmp_path: Path) -> None:
    first = write_pairs(tmp_path / "first", [random_pair(i, objects=2) for i in range(5)])
    second = write_pairs(tmp_path / "second", [random_pair(100 + i, objects=1) for i in range(3)])
    split = first.part.split
    joined = open_joined([tmp_path / "first", tmp_path / "second"], split)
    names, more = first.keys(), second.keys()
    assert joined.keys() == [f"first/{key}" for key in names] + [f"second/{key}" for key in more]
    assert joined.count_objects() == 13
    np.testing.assert_array_equal(joined[6].curr.color, second[1].curr.color)
    np.testing.assert_array_equal(joined[-8].curr.color, first[0].curr.color)
    with pytest.raises(IndexError):
        joined[8]

    batches = Batches(joined, 4, size=None, seed=0)
    assert batches.steps_per_pass == 2
    feed = batches.iterate()
    seen = [next(feed) for _ in range(2)]
    feed.close()
    assert sorted(key for batch in seen for key in batch.keys) == sorted(joined.keys())
    for batch in seen:
        for place, key in enumerate(batch.keys):
            row = joined[joined.keys().index(key)]
            np.testing.assert_array_equal(batch.curr_color[place].permute(1, 2, 0), row.curr.color)


def test_a_single_folder_keeps_its_keys_and_no_folder_comes_twice(tmp_path: Path) -> None:
    shards = write_pairs(tmp_path / "first", [random_pair(0, objects=2)])
    assert open_joined([tmp_path / "first"], shards.part.split).keys() == shards.keys()
    with pytest.raises(DatasetError, match="different folders"):
        open_joined([tmp_path / "first", tmp_path / "." / "first"], shards.part.split)


def test_a_damaged_file_of_either_set_is_found(tmp_path: Path) -> None:
    first = write_pairs(tmp_path / "first", [random_pair(0, objects=2)])
    second = write_pairs(tmp_path / "second", [random_pair(1, objects=2)])
    path = second.files()[0][0]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(DatasetError, match=r"second.*hash"):
        Batches(open_joined([first.folder, second.folder], first.part.split), 1, size=None, seed=0)
