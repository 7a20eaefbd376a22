"""Progress off a terminal: a line every ten seconds."""

from __future__ import annotations

import pytest

from objectflow.cli.progress import show_progress
from objectflow.runtime.quiet import silence_stderr


def test_a_line_every_ten_seconds_with_the_time_left(capfd: pytest.CaptureFixture[str]) -> None:
    times = iter([0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 24.0, 28.0])
    with show_progress("pairs", 7, clock=lambda: next(times)) as advance, silence_stderr():
        for _ in range(7):
            advance()
    assert capfd.readouterr().err.splitlines() == [
        "3 of 7 pairs, 4.00 s each, about 16 s left",
        "6 of 7 pairs, 4.00 s each, about 4 s left",
    ]


def test_short_work_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with show_progress("pairs", 2) as advance:
        advance()
        advance()
    assert capfd.readouterr().err == ""
