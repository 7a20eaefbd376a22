"""The training loop, readable from top to bottom: data, network, steps, validations, checkpoints."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field

import torch
from torch.nn.utils import clip_grad_norm_

from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.manifest import Manifest
from objectflow.errors import TrainingError
from objectflow.networks.weights import save_weights
from objectflow.training.adapters import NetworkAdapter
from objectflow.training.callbacks import Callback
from objectflow.training.checkpoint import (
    TrainState,
    checkpoints,
    load_checkpoint,
    remove_old_checkpoints,
    save_checkpoint,
)
from objectflow.training.curves import write_curve
from objectflow.training.ema import ExponentialMovingAverage
from objectflow.training.graceful_stop import GracefulStop
from objectflow.training.job import TrainJob, open_data, run_settings
from objectflow.training.metric_buffer import GRADIENT, MetricBuffer
from objectflow.training.parallel import Process, joined
from objectflow.training.prefetch import on_device
from objectflow.training.recipe import Recipe
from objectflow.training.run_folder import CHECKPOINTS, RunFolder, opened, read_metrics
from objectflow.training.setup import build_adapter, build_optimizer, compiled, precision
from objectflow.training.step import prepare, step_generator
from objectflow.training.validation import Validation, validate


@dataclass(frozen=True)
class Outcome:
    """How a run ended: its progress, whether it is complete, and the signal that stopped it (0: none)."""

    state: TrainState
    finished: bool
    signal: int = 0


@dataclass
class Run:
    """A run in progress; only the first process has a `folder`."""

    job: TrainJob
    process: Process
    callback: Callback
    folder: RunFolder | None
    train: Batches
    val: Batches | None
    data_hash: str
    adapter: NetworkAdapter
    optimizer: torch.optim.Optimizer
    average: ExponentialMovingAverage | None
    state: TrainState
    started: float = field(default_factory=time.monotonic)

    @property
    def total(self) -> int | None:
        """Total number of steps; None if only time limits them."""
        return self.job.recipe.total_steps(self.train.steps_per_pass)

    @property
    def best_adapter(self) -> NetworkAdapter:
        """The network to validate and to ship: the moving average if there is one."""
        return self.adapter if self.average is None else self.average.adapter

    def progress(self) -> float:
        """The share of the run that is done, 0..1."""
        minutes = self.job.recipe.minutes
        by_steps = 0.0 if self.total is None else self.state.step / self.total
        by_time = 0.0 if minutes is None else self.state.seconds / (60 * minutes)
        return min(1.0, max(by_steps, by_time))


def train(job: TrainJob, callback: Callback | None = None) -> Outcome:
    """Train a network, or continue its training; see `Recipe` for how, and `RunFolder` for what is written.

    Args:
        job: the request.
        callback: called in the first process only.

    Raises:
        TrainingError: a folder that holds something else, settings that do not fit, or losses that are not finite.
        DatasetError: no data set, a wrong hash, no objects, or rows that cannot be read.
        MethodError: weights that do not fit, or no such device.
        StorageError: a file cannot be written.
    """
    with contextlib.ExitStack() as stack:
        process = stack.enter_context(joined(job.device))
        _configure_torch(job.recipe, process.device)
        manifest = Manifest.read(job.data)
        others = [Manifest.read(folder) for folder in job.extra_data]
        batches, val = open_data(job, process, manifest)
        adapter = build_adapter(job.recipe, process, backbone=job.backbone, start=job.start)
        optimizer = build_optimizer(job.recipe, adapter.network, process.device)
        average = ExponentialMovingAverage(adapter, job.recipe.ema_decay) if job.recipe.ema_decay else None
        folder = None
        if process.first:
            settings = run_settings(job, process, manifest, others)
            folder = stack.enter_context(opened(job.out, settings, resume=job.resume))
        process.wait()
        state = TrainState()
        found = checkpoints(job.out / CHECKPOINTS) if job.resume else []
        if found:
            state = load_checkpoint(found[-1], adapter.network, optimizer, average)
        if folder is not None:
            folder.cut(state.step)
            # A run that was killed after its last checkpoint may have left one too many.
            remove_old_checkpoints(folder.checkpoints, job.recipe.keep_checkpoints)
        callback = callback if callback is not None and process.first else Callback()
        stack.callback(callback.close)
        data_hash = " + ".join(one.sha256 for one in (manifest, *others))
        run = Run(job, process, callback, folder, batches, val, data_hash, adapter, optimizer, average, state)
        if run.progress() >= 1:
            return Outcome(state, finished=True)
        if val is None:
            callback.note("no validation: the last weights are kept, not the best")
        with GracefulStop() as stopping, contextlib.closing(_feed(run)) as feed:
            return _loop(run, feed, stopping)


def _loop(run: Run, feed: Iterator[Batch], stopping: GracefulStop) -> Outcome:
    recipe, process, device = run.job.recipe, run.process, run.process.device
    with stopping.ignored_by_children():
        first = next(feed)  # starts the processes that read data
    trial = prepare(first, recipe, step_generator(recipe.seed, run.state.step, process.rank, device))
    forward = process.shared(compiled(run.adapter.module, recipe, trial.images, device, run.callback.note))
    parameters = list(run.adapter.network.parameters())
    buffer = MetricBuffer(process)
    seconds_before = run.state.seconds
    saved = lapped = time.monotonic()
    run.callback.start(run.state.step, run.total)
    for batch in itertools.chain([first], feed):
        # 1. The learning rate and the batch; augmentation and noise depend on the step's number alone.
        for group in run.optimizer.param_groups:
            group["lr"] = recipe.learning_rate_at(run.progress())
        generator = step_generator(recipe.seed, run.state.step, process.rank, device)
        prepared = prepare(batch, recipe, generator)
        # 2. The forward pass in the recipe's precision, and the losses in float32.
        with precision(recipe, device):
            output = forward(*prepared.images)
        losses = run.adapter.losses(output, prepared)
        # 3. The backward pass and one optimiser step.
        run.optimizer.zero_grad(set_to_none=True)
        losses["total"].backward()  # type: ignore[no-untyped-call]
        gradient = clip_grad_norm_(parameters, recipe.clip or float("inf"))
        run.optimizer.step()
        if run.average is not None:
            run.average.update()
        step = run.state.step + 1
        run.state = dataclasses.replace(run.state, step=step)
        buffer.add(step, batch.keys, losses, gradient)

        # 4. Every few steps, read the losses, the clock and pending signals.
        alone = process.world_size == 1
        if not (
            step % recipe.log_every == 0
            or step % recipe.validate_every == 0
            or step == run.total
            or (alone and stopping.signal)
        ):
            continue
        steps, values = len(buffer), buffer.read()
        now = time.monotonic()
        speed = recipe.batch_size * steps / max(now - lapped, 1e-9)
        run.state = dataclasses.replace(run.state, seconds=process.largest(seconds_before + now - run.started))
        signal = int(process.largest(stopping.signal))
        ended = run.progress() >= 1
        _log(run, values, speed)
        # 5. Validate and save when due.
        if run.val is not None and (step % recipe.validate_every == 0 or ended):
            _validate(run, run.val)
        # The last checkpoint is the last file: a resumed run that finds it has nothing left to do.
        if ended and run.val is None:
            _write_weights(run, None)
        if ended or signal:
            _draw(run)
        if ended or signal or time.monotonic() - saved >= 60 * recipe.checkpoint_minutes:
            _save(run)
            saved = time.monotonic()
        if ended or signal:
            process.wait()
            return Outcome(run.state, finished=ended, signal=signal)
        lapped = time.monotonic()
    raise TrainingError("the data came to an end")  # batches are endless


def _configure_torch(recipe: Recipe, device: torch.device) -> None:
    """Global settings of torch for speed on a GPU; a CPU is not affected."""
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
        if recipe.precision == "bf16":
            torch.set_float32_matmul_precision("high")


def _feed(run: Run) -> Generator[Batch, None, None]:
    """Batches on the device, from the run's step on."""
    batches = run.train.iterate(run.state.step)
    ahead = on_device(batches, run.process.device)
    try:
        yield from ahead
    finally:
        for one in (ahead, batches):
            if isinstance(one, Generator):
                one.close()


def _log(run: Run, values: dict[str, float], speed: float) -> None:
    line = {
        "kind": "train",
        "step": run.state.step,
        "seconds": round(run.state.seconds, 3),
        "learning_rate": run.optimizer.param_groups[0]["lr"],
        "pairs_per_second": round(speed, 3),
        GRADIENT: values.pop(GRADIENT),
        "losses": values,
    }
    if run.folder is not None:
        run.folder.append(line)
    run.callback.line(run.state.step, run.progress(), line)


def _validate(run: Run, batches: Batches) -> None:
    """Validate, and write the weights if they are the best so far."""
    recipe, process = run.job.recipe, run.process
    count = -(-recipe.validation_pairs // recipe.batch_size)
    with contextlib.closing(_first(batches, count)) as pairs:
        result = validate(run.best_adapter, pairs, recipe, process)
    best = run.state.best is None or result.score < run.state.best
    if best:
        run.state = dataclasses.replace(run.state, best=result.score)
        _write_weights(run, result)
    if run.folder is not None:
        run.folder.append(
            {"kind": "validation", "step": run.state.step, "seconds": round(run.state.seconds, 3)} | result.to_dict()
        )
        _draw(run)
    run.callback.validated(run.state.step, result, best)


def _first(batches: Batches, count: int) -> Generator[Batch, None, None]:
    pairs = batches.one_pass()
    try:
        yield from itertools.islice(pairs, count)
    finally:
        if isinstance(pairs, Generator):
            pairs.close()


def _save(run: Run) -> None:
    if run.folder is not None:
        save_checkpoint(
            run.folder.checkpoints, run.adapter.network, run.optimizer, run.average, run.state,
            keep=run.job.recipe.keep_checkpoints,
        )  # fmt: skip


def _write_weights(run: Run, result: Validation | None) -> None:
    """Write the weights to ship; their header holds everything that their model card needs."""
    if run.folder is None:
        return
    recipe = run.job.recipe
    save_weights(
        run.folder.weights,
        run.best_adapter.network,
        {
            **run.adapter.header(),
            "size": list(recipe.size),
            "recipe_name": run.job.name,
            "recipe": recipe.to_dict(),
            "data": run.data_hash,
            "step": run.state.step,
            "seconds": round(run.state.seconds, 1),
            "metrics": None if result is None else result.to_dict(),
        },
    )


def _draw(run: Run) -> None:
    if run.folder is not None:
        write_curve(run.folder.curve, read_metrics(run.folder.path), title=run.job.recipe.model.method)
