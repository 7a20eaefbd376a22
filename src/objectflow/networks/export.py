"""Export of a network to an ONNX file with a fixed input size, verified against torch before it is written."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from objectflow.errors import MethodError, MissingExtraError
from objectflow.networks import SceneFlowNetOutput
from objectflow.networks.kinds import Network, kind_of
from objectflow.networks.rigidmatch.export_form import ExportableRigidMatch
from objectflow.storage import files

OPSET = 17
INPUTS = ("prev_color", "prev_points", "curr_color", "curr_points")
TOLERANCE = 1e-4
"""Largest allowed difference from torch, relative to a map's largest value; reordered sums differ by less."""


class _Form(NamedTuple):
    """The module that is traced, and the names of its outputs."""

    module: nn.Module
    outputs: tuple[str, ...]


def _until_solve(network: Any) -> _Form:
    module = ExportableRigidMatch(network)
    return _Form(module, module.outputs)


_FORMS: dict[str, Callable[[Any], _Form]] = {
    "sceneflownet": lambda network: _Form(network, SceneFlowNetOutput._fields),
    "rigidmatch": _until_solve,
}
"""How a network of each kind is exported."""


def export_onnx(
    path: str | Path, network: Network, size: tuple[int, int], metadata: Mapping[str, Any] | None = None
) -> dict[str, float]:
    """Write a network for frames of one size, atomically.

    The graph has the four inputs of `SceneFlowNet.forward`, (1, 3, H, W) with NaN where depth is missing, and the six
    maps of `SceneFlowNetOutput` as outputs, all by name. A `RigidMatch` has the outputs of `ExportableRigidMatch`,
    since ONNX has no singular value decomposition. The graph's metadata holds, as JSON under "objectflow", the
    network's settings, the size and `metadata`.

    Args:
        path: of the file; an existing one is replaced.
        network: in any mode, which it keeps.
        size: (H, W).
        metadata: of the weights.

    Returns:
        The largest difference between onnxruntime and torch for each map, relative to the map's largest value.

    Raises:
        MissingExtraError: onnx or onnxruntime is missing.
        MethodError: a size below 8x8, or a graph whose results differ from torch's.
        StorageError: the file cannot be written.
    """
    path = Path(path)
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise MissingExtraError(f"export needs {error.name}", "onnx") from error
    if min(size) < 8:
        raise MethodError(f"export needs a size of at least 8x8, not {size[0]}x{size[1]}")
    frames = _frames(size)
    data, expected = _trace(network, frames)
    model = onnx.load_model_from_string(data)
    onnx.checker.check_model(model)
    description = {"network": network.settings.to_dict(), "size": list(size), "metadata": dict(metadata or {})}
    onnx.helper.set_model_props(model, {"objectflow": json.dumps(description, sort_keys=True)})
    data = model.SerializeToString()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # errors only: the warnings concern onnxruntime's optimiser
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    found = session.run(list(expected), {name: frames[name].numpy() for name in INPUTS})
    differences = _compare(path, dict(zip(expected, found, strict=True)), expected)
    files.write_bytes(path, data)
    return differences


def _trace(network: Network, frames: dict[str, Tensor]) -> tuple[bytes, dict[str, Tensor]]:
    """The graph, and torch's results for the same frames."""
    training, device = network.training, next(network.parameters()).device
    form = _FORMS[kind_of(network.settings)](network)
    try:
        network.eval().cpu()
        with torch.no_grad(), warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
            warnings.simplefilter("ignore")  # tracing warns about fixed sizes, which are intended
            expected = dict(zip(form.outputs, form.module(*frames.values()), strict=True))
            torch.onnx.export(
                form.module,
                tuple(frames.values()),
                Path(folder) / "network.onnx",
                input_names=list(INPUTS),
                output_names=list(form.outputs),
                opset_version=OPSET,
                # The dynamo exporter needs another library, and minutes for the 441 displacements.
                dynamo=False,
            )
            data = (Path(folder) / "network.onnx").read_bytes()
    finally:
        network.train(training).to(device)
    return data, expected


def _frames(size: tuple[int, int]) -> dict[str, Tensor]:
    """Noise at a table's distance, with holes, so that every branch of the network is executed."""
    generator = torch.Generator().manual_seed(0)
    frames = {}
    for name in INPUTS:
        image = torch.rand(1, 3, *size, generator=generator)
        if name.endswith("points"):
            image[:, :, torch.rand(size, generator=generator) < 0.1] = torch.nan
        frames[name] = image
    return frames


def _compare(path: Path, found: dict[str, NDArray[Any]], expected: dict[str, Tensor]) -> dict[str, float]:
    differences = {}
    for name, value in expected.items():
        true = value.numpy()
        share = float(np.abs(found[name] - true).max() / max(np.abs(true).max(), 1e-6))
        if not share <= TOLERANCE:  # NaN fails this comparison too
            raise MethodError(f"{path}: not written: {name} differs from torch by {share:.1e} of its largest value")
        differences[name] = share
    return differences
