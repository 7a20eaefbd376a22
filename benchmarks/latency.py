"""Seconds per pair and peak memory of each method, relative to `dense-flow`: `python benchmarks/latency.py`.

The pairs are the analytic scenes of the tests with 1-6 moving objects, at each size. Every method runs in a separate
process, so that its peak memory can be measured.

Networks are timed at the paper's 240x320 in a separate table, part by part. Where no weights are released they are
random, at the paper's width. The time of the network does not depend on its weights, but that of the grouping does, so
the grouping and all later parts are given true maps with noise. `--stages` prints the time of every stage instead.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import platform
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.table import Table

from stages import measure_stages

REFERENCE = "dense-flow"
T = TypeVar("T")


@dataclasses.dataclass
class Settings:
    """Times methods on analytic pairs."""

    methods: tuple[str, ...] = ("consensus", "zero")
    """Methods by name; `dense-flow` is always timed for the ratio."""
    sizes: tuple[int, ...] = (320, 640)
    """Image widths; heights are three quarters of them."""
    pairs: int = 12
    """Scenes for each size."""
    repeats: int = 2
    """Runs of each scene; the faster one counts."""
    networks: tuple[str, ...] = ("sceneflownet-s", "sceneflownet-c", "sceneflownet-c-vl")
    """Learned methods by name."""
    rigidmatch: tuple[str, ...] = ("full", "cpu")
    """Sizes of `rigidmatch` with random weights; may be empty."""
    stages: bool = False
    """Print the seconds of every stage of the methods instead, with one and with two threads. Methods may then have
    settings, as in `sceneflownet-c-vl:weights=weights`."""
    device: str = "cpu"
    """Device of the networks."""
    threads: int = 2
    """Threads of torch on the CPU."""
    noise: float = 0.004
    """Metres: standard deviation of each component of the maps that are grouped."""


def measure(method: str, width: int, pairs: int, repeats: int) -> tuple[float, ...]:
    import analytic
    import objectflow

    scenes = [analytic.make_scene(1000 + seed, width=width, height=width * 3 // 4) for seed in range(pairs)]
    estimator = objectflow.load(method)
    estimator(scenes[0].prev, scenes[0].curr)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for scene in scenes:
        runs = []
        for _ in range(repeats):
            start = time.perf_counter()
            estimator(scene.prev, scene.curr)
            runs.append(time.perf_counter() - start)
        seconds.append(min(runs))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return statistics.median(seconds), max(seconds), max(before, peak) / 1024


@dataclasses.dataclass
class NetworkTimes:
    """Medians over the scenes, seconds."""

    weights: str
    network: float
    grouping: float
    average: float
    whole: float
    cpu: float
    refine: float
    peak_mib: float


def measure_network(name: str, settings: Settings) -> NetworkTimes:
    import torch

    import analytic
    import objectflow
    from objectflow import geometry
    from objectflow.alignment.frame_pair import FramePair
    from objectflow.alignment.refine_objects import refine_objects
    from objectflow.errors import MethodError
    from objectflow.methods import find_weights
    from objectflow.methods.labels import rigid_flow
    from objectflow.methods.sceneflownet import decoding
    from objectflow.networks import NetworkSettings, SceneFlowNet, SceneFlowNetOutput
    from objectflow.networks.weights import save_weights
    from true_maps import Truth

    class ThenTruth(torch.nn.Module):
        """Takes the network's time, and returns other maps."""

        def __init__(self, network: torch.nn.Module, maps: SceneFlowNetOutput) -> None:
            super().__init__()
            self.network, self.maps = network, maps

        def forward(self, *images: torch.Tensor) -> SceneFlowNetOutput:
            self.network(*images)
            return self.maps

    torch.set_num_threads(settings.threads)
    try:
        find_weights.find_weights(name)
        released = True
    except MethodError:
        released = False
    with tempfile.TemporaryDirectory() as folder:
        random = Path(folder) / "random.safetensors"
        if not released:
            network = SceneFlowNet(NetworkSettings(correlation=name != "sceneflownet-s"))
            save_weights(random, network, {"variant": name, "size": [240, 320]})
        weights = None if released else random
        estimator: Any = objectflow.load(name, camera="static", weights=weights, device=settings.device)
    network = estimator.network
    generator = torch.Generator().manual_seed(0)
    rows = []
    for seed in range(settings.pairs):
        scene = analytic.make_scene(1000 + seed, width=320, height=240)
        prev, curr = scene.prev, scene.curr
        object.__setattr__(estimator, "network", Truth(scene, scene.labels))
        true = estimator.predict([prev], [curr])
        noisy = {
            field: getattr(true, field) + settings.noise * torch.randn(true.center.shape, generator=generator)
            for field in ("center", "translation", "rotation")
        }
        maps = SceneFlowNetOutput(*(one.to(settings.device) for one in true._replace(**noisy)))
        object.__setattr__(estimator, "network", network)
        points = geometry.back_project(curr.depth, curr.camera)
        parts = [
            fastest(lambda: [one.cpu() for one in estimator.predict([prev], [curr])], settings.repeats),  # noqa: B023
            fastest(lambda: decoding.label_pixels(maps), settings.repeats),  # noqa: B023
        ]
        labels = decoding.label_pixels(maps)
        objects = decoding.average_objects(maps, labels, curr.valid)

        def average() -> None:
            rigid_flow(decoding.average_objects(maps, labels, curr.valid), labels, points)  # noqa: B023

        parts.append(fastest(average, settings.repeats))
        object.__setattr__(estimator, "network", ThenTruth(network, maps))
        parts.append(fastest(lambda: estimator(prev, curr), settings.repeats))  # noqa: B023
        parts.append(fastest(lambda: estimator(prev, curr), settings.repeats, time.process_time))  # noqa: B023
        parts.append(
            fastest(
                lambda: refine_objects(FramePair(prev, curr), labels, objects),  # noqa: B023
                settings.repeats,
            )
        )
        rows.append(parts)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    columns = [*(statistics.median(column) for column in zip(*rows, strict=True)), peak]
    return NetworkTimes("released" if released else "random", *columns)


def measure_rigidmatch(size: str, settings: Settings) -> tuple[int, float, float, float, float]:
    """Number of parameters; medians over the scenes of network, total and CPU seconds; peak MiB."""
    import torch

    import analytic
    import objectflow
    from objectflow.methods.network_io import scaled_size
    from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
    from objectflow.networks.weights import save_weights

    torch.set_num_threads(settings.threads)
    network = RigidMatch(RigidMatchSettings())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.safetensors"
        save_weights(path, network, {"size": [240, 320] if size == "full" else [120, 160]})
        # Every query counts as an object, so that the steps after the network have work.
        estimator: Any = objectflow.load(
            "rigidmatch", camera="static", weights=path, device=settings.device, threshold=0.0
        )
    rows = []
    for seed in range(settings.pairs):
        scene = analytic.make_scene(1000 + seed, width=320, height=240)
        height, width = scaled_size(scene.curr, estimator.size)
        small = [[frame.resized(width, height)] for frame in (scene.prev, scene.curr)]
        predict, whole = partial(estimator.predict, *small), partial(estimator, scene.prev, scene.curr)
        rows.append(
            (
                fastest(predict, settings.repeats),
                fastest(whole, settings.repeats),
                fastest(whole, settings.repeats, time.process_time),
            )
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    count = sum(one.numel() for one in network.parameters())
    medians = (statistics.median(column) for column in zip(*rows, strict=True))
    return count, *medians, peak


def time_rigidmatch(settings: Settings) -> None:
    table = Table(title=f"rigidmatch, {settings.device}, {settings.threads} threads; seconds per pair of 320x240")
    for column in ("size", "M parameters", "network", "whole", "whole, CPU", "peak MiB"):
        table.add_column(column, justify="left" if column == "size" else "right")
    for size in settings.rigidmatch:
        count, network, whole, cpu, peak = alone(measure_rigidmatch, size, settings)
        table.add_row(size, f"{count / 1e6:.2f}", f"{network:.3f}", f"{whole:.3f}", f"{cpu:.3f}", f"{peak:.0f}")
    Console(width=110).print(table)


def fastest(work: Callable[[], object], repeats: int, clock: Callable[[], float] = time.perf_counter) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        start = clock()
        work()
        seconds.append(clock() - start)
    return min(seconds)


def alone(work: Callable[..., T], *arguments: object) -> T:
    """The result of the work in a separate process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def time_networks(settings: Settings) -> None:
    table = Table(title=f"networks at 320x240, {settings.device}, {settings.threads} threads; seconds per pair")
    columns = (
        "method",
        "weights",
        "network",
        "grouping",
        "average, flow",
        "whole",
        "whole, CPU",
        "refine",
        "peak MiB",
    )
    for column in columns:
        table.add_column(column, justify="left" if column in ("method", "weights") else "right")
    for name in settings.networks:
        times = alone(measure_network, name, settings)
        parts = (times.network, times.grouping, times.average, times.whole, times.cpu, times.refine)
        table.add_row(name, times.weights, *(f"{value:.3f}" for value in parts), f"{times.peak_mib:.0f}")
    Console(width=110).print(table)


def time_stages(settings: Settings) -> None:
    """Stages of each method, beside the whole of the reference."""
    for method in dict.fromkeys((REFERENCE, *settings.methods)):
        times = {
            (width, threads): alone(measure_stages, method, width, settings.pairs, threads)
            for width in settings.sizes
            for threads in (1, 2)
        }
        table = Table(title=f"{method}: median milliseconds per pair, wall / CPU")
        table.add_column("stage")
        for width, threads in times:
            table.add_column(f"{width}x{width * 3 // 4}, {threads} thread{'s' * (threads > 1)}", justify="right")
        first = next(iter(times.values()))
        for stage in sorted(
            {stage for found in times.values() for stage in found}, key=lambda s: -first.get(s, (0,))[0]
        ):
            cells = (found.get(stage, (0.0, 0.0)) for found in times.values())
            table.add_row(stage, *(f"{1000 * wall:.0f} / {1000 * cpu:.0f}" for wall, cpu in cells))
        Console(width=150).print(table)


def _longest_first(times: dict[str, tuple[float, float]], stage: str) -> float:
    return -times.get(stage, (0.0, 0.0))[0]


def main(settings: Settings) -> None:
    if settings.stages:
        time_stages(settings)
        return
    if settings.methods:
        time_methods(settings)
    if settings.networks:
        time_networks(settings)
    if settings.rigidmatch:
        time_rigidmatch(settings)


def time_methods(settings: Settings) -> None:
    table = Table(title=f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}")
    for column in ("method", "size", "median s", "slowest s", f"times {REFERENCE}", "peak MiB"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for width in settings.sizes:
        rows = {}
        for method in dict.fromkeys((REFERENCE, *settings.methods)):
            rows[method] = alone(measure, method, width, settings.pairs, settings.repeats)
        for method, (median, slowest, peak) in rows.items():
            ratio = median / rows[REFERENCE][0]
            size = f"{width}x{width * 3 // 4}"
            table.add_row(method, size, f"{median:.3f}", f"{slowest:.3f}", f"{ratio:.2f}", f"{peak:.0f}")
    Console(width=110).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
