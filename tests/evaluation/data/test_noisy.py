"""Sensor noise in evaluation: reproducible, of the documented size, and without effect on the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from objectflow.cli import main
from objectflow.errors import DatasetError
from objectflow.evaluation.data.noisy import NoisyPairs
from objectflow.evaluation.data.sources import TINY, open_set


def test_frames_are_noisy_and_the_truth_is_not() -> None:
    exact = open_set(TINY)
    noisy = NoisyPairs(exact, "structured-light")
    assert noisy.keys == exact.keys
    assert noisy.sha256 not in (exact.sha256, NoisyPairs(exact, "stereo").sha256)
    key = exact.keys[2]
    one, seen, again = exact.pair(key), noisy.pair(key), noisy.pair(key)
    np.testing.assert_array_equal(seen.truth.scene_flow, one.truth.scene_flow)
    for before, frame, same in ((one.prev, seen.prev, again.prev), (one.curr, seen.curr, again.curr)):
        np.testing.assert_array_equal(frame.depth, same.depth)
        np.testing.assert_array_equal(frame.color, same.color)
        both = (before.depth > 0) & (frame.depth > 0)
        far = before.depth > 0.6  # nearer surfaces are outside the sensor's range
        assert 0.5 < both[far].mean() < 0.999  # some depth is lost, mostly at edges
        # Khoshelham and Elberink 2012: about 1.4 mm at 1 m, quadratic in depth; quantisation and edges add to it.
        measured = both & far
        error = np.median(np.abs(frame.depth - before.depth)[measured] / before.depth[measured] ** 2)
        assert 0.0003 < error < 0.005
        assert not np.array_equal(frame.color, before.color)


def test_an_unknown_sensor_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(DatasetError, match="choose one of structured-light"):
        NoisyPairs(open_set(TINY), "sonar")
    out = tmp_path / "out"
    assert main(["evaluate", "--data", "tiny", "--sensor", "sonar", "--methods", "zero", "--out", str(out)]) == 2
    assert "unknown depth sensor 'sonar'" in capsys.readouterr().err
    assert not out.exists()


def test_evaluate_names_the_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--data", "tiny", "--limit", "2", "--methods", "zero", "--no-report", "--out", str(tmp_path)]
    assert main(["evaluate", "--sensor", "stereo", *arguments]) == 0
    assert "tiny, stereo" in capsys.readouterr().out
    assert main(["evaluate", *arguments]) == 2  # the folder holds predictions of other pairs
