"""Killed where it changes the file system, each command makes the same files when it is repeated, and no others.

Each command is killed at a sample of its points; `python tests/kills/harness.py` kills it at all of them.
"""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import pytest

from kills.commands import COMMANDS, nothing, stopped_clocks
from kills.harness import Difference, kill_everywhere


@pytest.mark.parametrize(
    ("name", "sample", "least"),
    [
        ("estimate", 7, 20),
        ("estimate, replacing a result", 10, 30),
        ("run", 11, 80),
        ("run finding an object later", 7, 150),
        ("evaluate without a report", 6, 50),
        ("generate fake scenes", 9, 30),
        ("train with every feature", 4, 60),
    ],
)
def test_the_same_command_finishes_the_work(tmp_path: Path, name: str, sample: int, least: int) -> None:
    with stopped_clocks():
        kills, points, differences = kill_everywhere(
            *COMMANDS[name], tmp_path, sample=sample, seed=zlib.crc32(name.encode())
        )
    assert not differences
    assert kills == sample
    assert points >= least


@pytest.mark.parametrize("copies", [False, True])
def test_the_harness_finds_stray_and_different_files(tmp_path: Path, copies: bool) -> None:
    def command(folder: Path) -> None:
        if (folder / "begun").exists():  # Nothing removes this after a kill.
            (folder / "stray").write_text("x")
        (folder / "begun").write_text("x")
        (folder / "begun").unlink()
        (folder / "whole").write_text("x")

    kills, points, differences = kill_everywhere(command, nothing, tmp_path, copies=copies)
    # Creating begun, removing it, and creating whole are two points each.
    assert (kills, points) == (6, 6)
    assert differences == [Difference(point, ("stray",)) for point in (1, 2)]


@pytest.mark.parametrize("copies", [False, True])
def test_the_harness_cuts_writes(tmp_path: Path, copies: bool) -> None:
    def command(folder: Path) -> None:
        path = folder / "lines"
        kept = path.read_bytes() if path.exists() else b""
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        if kept != b"whole":
            os.write(descriptor, b"whole")
        os.close(descriptor)

    kills, points, differences = kill_everywhere(command, nothing, tmp_path, copies=copies)
    # Before and after the file is created; before, amid and after the write.
    assert (kills, points) == (5, 5)
    assert differences == [Difference(3, ("lines",))]
