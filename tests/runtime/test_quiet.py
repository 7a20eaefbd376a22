"""Standard error is discarded inside the block only, at the level of file descriptors."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from objectflow.runtime.quiet import silence_stderr

SCRIPT = """
import os, sys
from objectflow.runtime.quiet import silence_stderr
sys.stderr.write("before ")
with silence_stderr():
    os.write(2, b"native ")
    print("python", file=sys.stderr, flush=True)
os.write(2, b"after")
"""


def test_native_and_python_output_is_discarded() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], stderr=subprocess.PIPE, check=True, text=True)
    assert done.stderr == "before after"


def test_errors_pass_and_the_descriptor_is_restored(capfd: pytest.CaptureFixture[str]) -> None:
    descriptors = len(os.listdir("/proc/self/fd"))
    with pytest.raises(ValueError, match="mine"), silence_stderr():
        raise ValueError("mine")
    os.write(2, b"after")
    assert capfd.readouterr().err == "after"
    assert len(os.listdir("/proc/self/fd")) == descriptors
