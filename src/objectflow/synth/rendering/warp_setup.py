"""Starts Warp and mujoco-warp, keeps them quiet, and cleans up after them."""

from __future__ import annotations

import functools
import gc
import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

from objectflow.errors import MissingExtraError, ObjectflowError


def import_tracer() -> tuple[ModuleType, ModuleType]:
    """Warp and mujoco-warp, started.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        import warp
    except ImportError as error:
        raise MissingExtraError('rendering needs mujoco-warp: pip install "objectflow[synth]"') from error
    with quiet(warp), _without_standard_error():
        try:
            import mujoco_warp
        except ImportError as error:
            raise MissingExtraError('rendering needs mujoco-warp: pip install "objectflow[synth]"') from error
        warp.init()
    _remember_versions()
    return warp, mujoco_warp


def _remember_versions() -> None:
    """Let mujoco-warp look up MuJoCo's version once, and not ninety times a scene: a tenth of a scene's time.

    A release that has the function elsewhere is only slower.
    """
    with suppress(ImportError, AttributeError):
        package: Any = importlib.import_module("mujoco_warp._src.util_pkg")
        if not hasattr(package.check_version, "cache_info"):
            package.check_version = functools.cache(package.check_version)


def find_warp_device(warp: ModuleType, device: str) -> Any:
    """Warp's device of "cpu" or "cuda".

    Raises:
        ObjectflowError: there is none.
    """
    if device not in ("cpu", "cuda"):
        raise ObjectflowError(f"there is no device {device!r}: choose cpu or cuda")
    if device == "cuda" and not warp.is_cuda_available():
        raise ObjectflowError("no CUDA device is found for rendering: choose --device cpu")
    return warp.get_device("cuda:0" if device == "cuda" else "cpu")


@contextmanager
def quiet(warp: ModuleType) -> Iterator[None]:
    """Hold back what Warp prints as it starts and loads its modules, unless somebody asked it for all it can say."""
    level = warp.config.log_level
    warp.config.log_level = max(level, warp.LOG_WARNING) if level > warp.LOG_DEBUG else level
    try:
        yield
    finally:
        warp.config.log_level = level


@contextmanager
def _without_standard_error() -> Iterator[None]:
    """Drop what even native code writes there: Warp's warning that there is no CUDA driver is not for everybody."""
    sys.stderr.flush()
    kept = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


@contextmanager
def cycles_freed() -> Iterator[None]:
    """Free at once what refers to itself.

    mujoco-warp leaves objects behind that refer to each other and to the scene. Python frees them only when it next
    goes through everything there is, hundreds of scenes later, and does not know how many megabytes a scene holds.
    What is made here stays young as long as nothing is collected meanwhile, and going through the young is quick.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.collect(0)
        if enabled:
            gc.enable()
