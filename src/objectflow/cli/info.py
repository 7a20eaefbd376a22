"""`objectflow info`: versions, devices and weights, for bug reports."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib import metadata

from rich.console import Console
from rich.table import Table

EXAMPLES = "  objectflow info\n"

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "torch", "tyro", "rich", "safetensors")
OPTIONAL_LIBRARIES = (
    "mujoco", "mujoco-warp", "trimesh", "coacd", "pyarrow", "pybullet", "ray", "onnx", "onnxruntime", "huggingface_hub"
)  # fmt: skip


@dataclass(frozen=True)
class Info:
    """Print the installed versions, devices and weights."""

    def run(self) -> None:
        """Print the table."""
        import torch

        import objectflow

        table = Table(box=None, pad_edge=False, show_header=False)
        table.add_row("objectflow", objectflow.__version__)
        table.add_row("python", f"{platform.python_version()} on {platform.platform()}")
        for name in LIBRARIES:
            table.add_row(name, _version(name) or "not installed")
        for name in OPTIONAL_LIBRARIES:
            version = _version(name)
            table.add_row(name, f"{version} (optional)" if version else "not installed (optional)")
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        table.add_row("cpu", f"{cores} cores, {torch.get_num_threads()} threads in torch")
        for index in range(torch.cuda.device_count()):
            memory = torch.cuda.get_device_properties(index).total_memory / 2**30
            table.add_row(f"cuda:{index}", f"{torch.cuda.get_device_name(index)}, {memory:.0f} GiB")
        if not torch.cuda.is_available():
            table.add_row("cuda", "no device")
        table.add_row("weights", ", ".join(_weights()) or "none")
        Console(highlight=False).print(table)


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _weights() -> list[str]:
    from objectflow.errors import MethodError
    from objectflow.methods.find_weights import packaged_weights
    from objectflow.networks.weights import read_header

    found = []
    for path in packaged_weights():
        try:
            _, header = read_header(path)
            height, width = header.get("size", ("?", "?"))
            found.append(f"{path.stem} ({path.stat().st_size / 2**20:.1f} MiB, frames resized to {width}x{height})")
        except (MethodError, TypeError, ValueError):
            found.append(f"{path.stem} (damaged: install objectflow again)")
    return found
