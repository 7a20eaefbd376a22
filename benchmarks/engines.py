"""CPU seconds of the `rigidmatch` network per pair on different engines: `python benchmarks/engines.py`.

The engines are torch in float32, torch with bfloat16 autocast on processors that have instructions for it, ONNX
Runtime in float32, and ONNX Runtime with its convolutions in int8, calibrated on other pairs; and OpenVINO in float32
and, on such processors, in bfloat16, if it is installed (`pip install openvino`). All of them run what
`objectflow export` writes, the network up to the solve; `torch` is the form that estimates use, which does not make
the table of all pairs' scores. Engines take turns on the pairs, so that all of them see the same load.

The differences are the largest ones from torch in float32: of the matches in metres, on pixels with depth, and of the
masks as probabilities. Lines of weights that do not exist are left out.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

import analytic
import objectflow
from objectflow.methods.network_io import scaled_size, to_tensors
from objectflow.networks.export import INPUTS, export_onnx
from objectflow.networks.rigidmatch import RigidMatch

Tensors = dict[str, torch.Tensor]
Engine = Callable[[Tensors], dict[str, NDArray[Any]]]
CALIBRATION_SEED, PAIR_SEED = 2000, 1000


@dataclasses.dataclass
class Settings:
    """Times engines on analytic pairs of 640x480."""

    weights: tuple[str, ...] = ("src/objectflow/weights",)
    """Folders or files of weights."""
    pairs: int = 6
    """Pairs that are timed, after one that is not."""
    calibration: int = 8
    """Pairs on which int8 is calibrated; 0 leaves int8 out."""
    threads: int = 1
    """Threads of each engine."""


def inputs_of(estimator: Any, seed: int) -> Tensors:
    """The network's four inputs for an analytic pair, as estimates make them."""
    scene = analytic.make_scene(seed, width=640, height=480)
    height, width = scaled_size(scene.curr, estimator.size)
    frames = [frame.resized(width, height) for frame in (scene.prev, scene.curr)]
    tensors = [one for frame in frames for one in to_tensors([frame], torch.device("cpu"))]
    return dict(zip(INPUTS, tensors, strict=True))


def in_torch(network: RigidMatch, *, table: bool, bfloat16: bool = False) -> Engine:
    """The network in torch, up to the solve."""

    def run(inputs: Tensors) -> dict[str, NDArray[Any]]:
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            found = network.forward_features(*inputs.values(), table=table)
        names = {"match": found.refined.match, "masks": found.objects.masks[-1], "valid": found.points.valid}
        return {name: value.float().numpy() for name, value in names.items()}

    return run


def in_onnxruntime(path: Path, threads: int) -> Engine:
    """A graph in ONNX Runtime."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    names = ["match", "masks"]

    def run(inputs: Tensors) -> dict[str, NDArray[Any]]:
        arrays = {name: np.ascontiguousarray(value.numpy()) for name, value in inputs.items()}
        return dict(zip(names, session.run(names, arrays), strict=True))

    return run


def in_openvino(path: Path, threads: int, precision: str) -> Engine:
    """A graph in OpenVINO, in `f32` or `bf16`."""
    import openvino

    options = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": precision, "PERFORMANCE_HINT": "LATENCY"}
    request = openvino.Core().compile_model(str(path), "CPU", options).create_infer_request()
    names = ["match", "masks"]

    def run(inputs: Tensors) -> dict[str, NDArray[Any]]:
        found = request.infer({name: np.ascontiguousarray(value.numpy()) for name, value in inputs.items()})
        return {name: np.array(found[name]) for name in names}

    return run


def in_int8(path: Path, samples: Iterator[Tensors]) -> Path:
    """The graph with its convolutions in int8, beside the one in float32."""
    from onnxruntime import quantization
    from onnxruntime.quantization.shape_inference import quant_pre_process

    class Samples(quantization.CalibrationDataReader):  # type: ignore[misc]
        def get_next(self) -> dict[str, NDArray[Any]] | None:
            found = next(samples, None)
            return None if found is None else {k: np.ascontiguousarray(v.numpy()) for k, v in found.items()}

    prepared, quantized = path.with_suffix(".prepared.onnx"), path.with_suffix(".int8.onnx")
    quant_pre_process(path, prepared, skip_symbolic_shape=True)
    quantization.quantize_static(
        prepared, quantized, Samples(), op_types_to_quantize=["Conv"], per_channel=True, reduce_range=False
    )
    return quantized


def has_bfloat16() -> bool:
    """Whether this processor computes in bfloat16; others only emulate it."""
    found = torch.cpu.get_capabilities()
    return any(found.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def measure(weights: str, settings: Settings, folder: Path) -> list[tuple[str, float, float, float]]:
    """Engine, CPU seconds, and the differences of matches and masks."""
    estimator: Any = objectflow.load("rigidmatch", weights=weights, camera="static", device="cpu")
    network, size = (
        estimator.network,
        scaled_size(analytic.make_scene(PAIR_SEED, width=640, height=480).curr, estimator.size),
    )
    engines: dict[str, Engine] = {"torch float32": in_torch(network, table=False)}
    engines["torch float32, exported form"] = in_torch(network, table=True)
    if has_bfloat16():
        engines["torch bfloat16"] = in_torch(network, table=False, bfloat16=True)
    path = folder / "network.onnx"
    export_onnx(path, network, size)
    engines["onnxruntime float32"] = in_onnxruntime(path, settings.threads)
    if importlib.util.find_spec("openvino") is not None:
        engines["openvino float32"] = in_openvino(path, settings.threads, "f32")
        if has_bfloat16():
            engines["openvino bfloat16"] = in_openvino(path, settings.threads, "bf16")
    if settings.calibration:
        samples = (inputs_of(estimator, CALIBRATION_SEED + k) for k in range(settings.calibration))
        engines["onnxruntime int8 convolutions"] = in_onnxruntime(in_int8(path, samples), settings.threads)
    seconds: dict[str, list[float]] = {name: [] for name in engines}
    worst: dict[str, list[tuple[float, float]]] = {name: [] for name in engines}
    for k in range(settings.pairs + 1):
        inputs = inputs_of(estimator, PAIR_SEED + k)
        expected: dict[str, NDArray[Any]] = {}
        for name, engine in engines.items():
            start = time.process_time()
            found = engine(inputs)
            spent = time.process_time() - start
            expected = expected or found
            if k:
                seconds[name].append(spent)
            known = np.broadcast_to(expected["valid"] > 0, found["match"].shape)
            apart = [
                float(np.abs(found["match"] - expected["match"])[known].max()),
                float(np.abs(_sigmoid(found["masks"]) - _sigmoid(expected["masks"])).max()),
            ]
            worst[name].append((apart[0], apart[1]))
    return [
        (name, statistics.median(seconds[name]), *(max(column) for column in zip(*worst[name], strict=True)))
        for name in engines
    ]


def _sigmoid(logits: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(1 / (1 + np.exp(-logits.clip(-60, 60))))


def main(settings: Settings) -> None:
    """Measure, print."""
    torch.set_num_threads(settings.threads)
    table = Table(title=f"rigidmatch up to the solve, a pair of 640x480, {settings.threads} threads")
    table.add_column("weights")
    table.add_column("engine")
    for name in ("CPU s", "to torch", "match, m", "mask"):
        table.add_column(name, justify="right")
    for weights in settings.weights:
        if not Path(weights).exists():
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows = measure(weights, settings, Path(folder))
        for name, seconds, match, mask in rows:
            ratio = seconds / rows[0][1]
            table.add_row(weights, name, f"{seconds:.3f}", f"{ratio:.2f}", f"{match:.1e}", f"{mask:.1e}")
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
