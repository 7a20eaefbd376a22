"""Stamps of every unit, with repeats, gaps, late frames and clock changes."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow.errors import ReaderError
from objectflow.readers.timestamps import find_unit, normalise, segment_numbers

STEADY = 0.3 * np.arange(8) + 100.0


@pytest.mark.parametrize("start", [0.0, 0.5, 100.0, 1305031102.175304, 1.7e9])
@pytest.mark.parametrize("period", [1 / 90, 1 / 30, 0.3, 2.0])
@pytest.mark.parametrize(("unit", "factor"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_units_are_found_by_magnitude(start: float, period: float, unit: str, factor: float) -> None:
    seconds = start + period * np.arange(1, 20)
    found = normalise(seconds * factor)
    assert find_unit(seconds * factor) == unit
    np.testing.assert_allclose(found.times_s, seconds, rtol=1e-12, atol=1e-6)
    assert found.cuts == ()
    assert len(found.notes) == (unit != "s")


def test_dates_in_seconds_may_lie_far_apart() -> None:
    assert find_unit([1.7e9, 1.7e9 + 60, 1.7e9 + 120]) == "s"
    assert find_unit([1.7e9]) == "s"
    assert find_unit([1.7e18]) == "ns"
    assert find_unit([1.0e9, 1.0333e9, 1.0667e9]) == "ns"  # one second after the start of a device


def test_regular_stamps_are_unchanged() -> None:
    found = normalise(STEADY)
    np.testing.assert_array_equal(found.times_s, STEADY)
    np.testing.assert_array_equal(found.kept, np.arange(8))
    assert found.notes == ()
    assert len(normalise([]).kept) == 0


def test_repeats_are_dropped() -> None:
    found = normalise(np.repeat(STEADY, 2))
    np.testing.assert_array_equal(found.times_s, STEADY)
    np.testing.assert_array_equal(found.kept, np.arange(0, 16, 2))
    assert found.cuts == ()
    assert "8 repeated stamps" in found.notes[0]


def test_interleaved_repeats_are_told_from_a_clock_change_by_the_time_of_recording() -> None:
    stamps = [100.0, 100.3, 100.0, 100.3, 100.6, 100.9]
    two_recorders = normalise(stamps, recorded=[0.0, 0.3, 0.31, 0.32, 0.6, 0.9])
    assert two_recorders.cuts == ()
    np.testing.assert_array_equal(two_recorders.kept, [0, 1, 4, 5])
    set_back = normalise(stamps, recorded=0.3 * np.arange(6))
    assert set_back.cuts == (2,)
    np.testing.assert_array_equal(set_back.kept, np.arange(6))


@pytest.mark.parametrize("step", [0.35, 1.05, 40.0])
def test_a_clock_set_back_is_a_cut(step: float) -> None:
    stamps = np.where(np.arange(8) < 4, STEADY, STEADY - step)
    found = normalise(stamps, recorded=STEADY)
    assert found.cuts == (4,)
    np.testing.assert_array_equal(found.kept, np.arange(8))
    np.testing.assert_array_equal(segment_numbers(found), [0] * 4 + [1] * 4)
    assert f"goes back by {STEADY[3] - stamps[4]:.3f} s after 4 frames" in found.notes[0]


def test_a_loop_is_a_cut() -> None:
    found = normalise(np.tile(STEADY, 3))
    assert found.cuts == (8, 16)
    assert len(found.kept) == 24


def test_a_loop_from_zero_keeps_its_first_frame() -> None:
    found = normalise(np.tile(0.1 * np.arange(5), 2))
    assert found.cuts == (5,)
    np.testing.assert_allclose(found.times_s[[0, 5]], 0)
    assert "missing" not in " ".join(found.notes)


def test_a_late_frame_is_sorted_in() -> None:
    order = [0, 1, 3, 2, 4, 5, 6, 7]
    found = normalise(STEADY[order])
    np.testing.assert_array_equal(found.times_s, STEADY)
    np.testing.assert_array_equal(found.kept, order)
    assert found.cuts == ()
    assert "1 frame recorded late" in found.notes[0]


@pytest.mark.parametrize("at", [0, 3, 7])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_missing_stamps_are_interpolated(at: int, value: float) -> None:
    stamps = STEADY.copy()
    stamps[at] = value
    found = normalise(stamps)
    np.testing.assert_allclose(found.times_s, STEADY, atol=1e-9)
    assert "1 of 8 stamps is missing" in found.notes[0]


def test_missing_stamps_follow_the_times_of_recording() -> None:
    arrivals = STEADY + np.array([0, 0, 0, 0.1, 0, 0, 0, 0])
    stamps = STEADY.copy()
    stamps[3] = 0
    found = normalise(stamps, recorded=1e9 * arrivals)
    assert found.times_s[3] == pytest.approx(STEADY[3] + 0.1)


def test_times_of_recording_replace_stamps_that_are_all_missing() -> None:
    found = normalise(np.zeros(8), unit="ns", recorded=1e9 * STEADY)
    np.testing.assert_allclose(found.times_s, STEADY)
    with pytest.raises(ReaderError, match="no time stamp is valid"):
        normalise(np.zeros(3))
