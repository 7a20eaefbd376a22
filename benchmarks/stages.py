"""Seconds of every stage of a method, for `latency.py --stages`.

The functions that make up each stage are wrapped for the measurement. Time inside a nested stage counts for that stage
alone. With one thread, the stages add up to the whole. With more, some of them run beside each other, `rest` includes
the wait for side threads, and the CPU time of a stage is that of the thread that runs it.
"""

from __future__ import annotations

import functools
import importlib
import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

REST = "rest"
"""The time of a pair that lies in none of the stages."""
STAGES: dict[str, tuple[str, ...]] = {
    "optical flow": ("objectflow.alignment.matching:dense_flow",),
    "features": ("objectflow.alignment.matching:feature_matches",),
    "camera's motion": ("objectflow.alignment.camera_estimate:background_motion",),
    "light": (
        "objectflow.alignment.camera_estimate:fit_light_change",
        "objectflow.alignment.camera_estimate:in_current_light",
    ),
    "depth noise": ("objectflow.alignment.camera_estimate:measure_depth_noise",),
    "camera check": ("objectflow.alignment.camera_estimate:_judged",),
    "compensated view": ("objectflow.methods.moving_camera:as_seen_from",),
    "network": (
        "objectflow.methods.rigidmatch.estimator:RigidMatchEstimator.predict",
        "objectflow.methods.sceneflownet.estimator:SceneFlowNetCVL.predict",
    ),
    "decoding": ("objectflow.methods.rigidmatch.estimator:decode",),
    "proposals": ("objectflow.methods.consensus.estimator:propose",),
    "assignment": ("objectflow.methods.consensus.assignment:Assignment.assign",),
    "pixel graph": ("objectflow.methods.consensus.assignment:PixelGraph",),
    "registration": ("objectflow.alignment.registration:refine",),
    "labels to full size": (
        "objectflow.methods.consensus.estimator:upsample_labels",
        "objectflow.methods.postprocess.reassign_pixels:upsample_labels",
        "objectflow.methods.mask_edges:upsample_labels",
    ),
    "flow of motions": ("objectflow.methods.rigidmatch.estimator:rigid_flow",),
}
"""Stages by name, each with its functions as `module:name`, in the module that calls them."""


class StageClock:
    """Adds up wall and CPU seconds per stage; `install` wraps the functions in the running process."""

    def __init__(self) -> None:
        self.wall: defaultdict[str, float] = defaultdict(float)
        self.cpu: defaultdict[str, float] = defaultdict(float)
        self._thread = threading.local()

    def wrap(self, stage: str, work: Callable[..., Any]) -> Callable[..., Any]:
        """The function, whose own time counts for a stage."""

        @functools.wraps(work)
        def timed(*arguments: Any, **options: Any) -> Any:
            inside = [0.0, 0.0]
            nested = vars(self._thread).setdefault("open", [])
            nested.append(inside)
            wall, cpu = time.perf_counter(), time.thread_time()
            try:
                return work(*arguments, **options)
            finally:
                spent = time.perf_counter() - wall, time.thread_time() - cpu
                nested.pop()
                self.wall[stage] += spent[0] - inside[0]
                self.cpu[stage] += spent[1] - inside[1]
                if nested:
                    nested[-1][0] += spent[0]
                    nested[-1][1] += spent[1]

        return timed

    def install(self) -> None:
        """Wrap the functions of all stages and the steps after a network.

        Raises:
            AttributeError: the package has no such function.
        """
        for stage, places in STAGES.items():
            for place in places:
                module, _, name = place.partition(":")
                owner: Any = importlib.import_module(module)
                *parents, last = name.split(".")
                for parent in parents:
                    owner = getattr(owner, parent)
                setattr(owner, last, self.wrap(stage, getattr(owner, last)))
        steps = importlib.import_module("objectflow.methods.postprocess.pipeline").STEPS
        for name, step in steps.items():
            steps[name] = self.wrap(f"step {name}", step)


def measure_stages(method: str, width: int, pairs: int, threads: int) -> dict[str, tuple[float, float]]:
    """Median wall and CPU seconds per pair of each stage and of the whole, in this process."""
    import cv2
    import torch

    import analytic
    from objectflow.evaluation.methods import parse_methods

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    scenes = [analytic.make_scene(1000 + seed, width=width, height=width * 3 // 4) for seed in range(pairs)]
    estimator = parse_methods([method])[0].make()
    estimator(scenes[0].prev, scenes[0].curr)
    clock = StageClock()
    clock.install()
    rows: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    whole = clock.wrap(REST, estimator)
    for scene in scenes:
        clock.wall.clear()
        clock.cpu.clear()
        start = time.perf_counter(), time.process_time()
        whole(scene.prev, scene.curr)
        spent = time.perf_counter() - start[0], time.process_time() - start[1]
        for stage in {*clock.wall, *rows}:
            rows[stage].append((clock.wall[stage], clock.cpu[stage]))
        rows["whole"].append(spent)
    missing = {stage: pairs - len(found) for stage, found in rows.items()}
    return {
        stage: tuple(statistics.median([*column, *[0.0] * missing[stage]]) for column in zip(*found, strict=True))
        for stage, found in rows.items()
    }
