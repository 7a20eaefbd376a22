"""Start-up of Warp and mujoco-warp, their log level, and their garbage."""

from __future__ import annotations

import functools
import gc
import importlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

from objectflow.errors import MissingExtraError, ObjectflowError
from objectflow.runtime.quiet import silence_stderr


def import_tracer() -> tuple[ModuleType, ModuleType]:
    """Import and start Warp and mujoco-warp.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        import warp
    except ImportError as error:
        raise MissingExtraError("rendering needs mujoco-warp", "synth") from error
    # Warp warns about a missing CUDA driver, which most machines do not need.
    with quiet(warp), silence_stderr():
        try:
            import mujoco_warp
        except ImportError as error:
            raise MissingExtraError("rendering needs mujoco-warp", "synth") from error
        warp.init()
    _cache_version_checks()
    return warp, mujoco_warp


def _cache_version_checks() -> None:
    """Make mujoco-warp look up MuJoCo's version once instead of ninety times per scene: a tenth of the time.

    Releases without this function are slower but otherwise unaffected.
    """
    with suppress(ImportError, AttributeError):
        package: Any = importlib.import_module("mujoco_warp._src.util_pkg")
        if not hasattr(package.check_version, "cache_info"):
            package.check_version = functools.cache(package.check_version)


def find_warp_device(warp: ModuleType, device: str) -> Any:
    """The Warp device of "cpu" or "cuda".

    Raises:
        ObjectflowError: another name, or no CUDA device.
    """
    if device not in ("cpu", "cuda"):
        raise ObjectflowError(f"there is no device {device!r}: choose cpu or cuda")
    if device == "cuda" and not warp.is_cuda_available():
        raise ObjectflowError("no CUDA device is found for rendering: choose --device cpu")
    return warp.get_device("cuda:0" if device == "cuda" else "cpu")


@contextmanager
def quiet(warp: ModuleType) -> Iterator[None]:
    """Suppress the messages of Warp about its start and its modules, unless its log level is DEBUG."""
    level = warp.config.log_level
    warp.config.log_level = max(level, warp.LOG_WARNING) if level > warp.LOG_DEBUG else level
    try:
        yield
    finally:
        warp.config.log_level = level


@contextmanager
def cycles_freed() -> Iterator[None]:
    """Free reference cycles at the end of the block.

    mujoco-warp leaves objects that refer to each other and to the scene. Python would free them only at the next full
    collection, hundreds of scenes later, since it does not know how many megabytes a scene holds. As long as nothing
    is collected inside the block, these objects stay in the youngest generation, whose collection is fast.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.collect(0)
        if enabled:
            gc.enable()
