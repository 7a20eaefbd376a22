"""Training, from top to bottom: data, network, steps, validations, checkpoints."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch.nn.utils import clip_grad_norm_

from objectflow import __version__
from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.concatenated import open_joined
from objectflow.dataset.manifest import Manifest, Part
from objectflow.dataset.shards import open_pairs
from objectflow.errors import TrainingError
from objectflow.networks.weights import Network, save_weights
from objectflow.storage.files import hash_file
from objectflow.training.adapters import losses_of, trained_form
from objectflow.training.callbacks import Callback
from objectflow.training.checkpoint import TrainState, checkpoints, load_checkpoint, save_checkpoint
from objectflow.training.curves import write_curve
from objectflow.training.ema import ExponentialMovingAverage
from objectflow.training.graceful_stop import GracefulStop
from objectflow.training.metric_buffer import GRADIENT, MetricBuffer
from objectflow.training.parallel import Process, joined
from objectflow.training.prefetch import on_device
from objectflow.training.recipe import Recipe
from objectflow.training.run_folder import CHECKPOINTS, RunFolder, opened, read_metrics
from objectflow.training.setup import build_network, build_optimizer, compiled, precision
from objectflow.training.step import prepare, step_generator
from objectflow.training.validation import Validation, validate


@dataclass(frozen=True)
class TrainJob:
    """What is asked for.

    Attributes:
        name: the recipe's, for the record.
        recipe: how to train.
        data: folder of a data set with the split train, and val for validation.
        out: the run's folder.
        also: more data sets; pairs of their split train are mixed in, each as often as any other.
        resume: go on from the last checkpoint there, if there is one.
        device: "auto", "cpu", "cuda" or "cuda:N".
        backbone: torchvision's `resnet50` state dict to start the colour trunk from.
        start: weights of an earlier run to start from.
        validate_on: the split; "train" shows how well the pairs themselves are learnt by heart.
    """

    name: str
    recipe: Recipe
    data: Path
    out: Path
    also: tuple[Path, ...] = ()
    resume: bool = False
    device: str = "auto"
    backbone: Path | None = None
    start: Path | None = None
    validate_on: str = "val"


@dataclass(frozen=True)
class Outcome:
    """How a run ended: how far it came, whether that was its end, and the signal (0 for none) that stopped it."""

    position: TrainState
    finished: bool
    signal: int = 0


@dataclass
class Run:
    """A run in progress; `folder` is None but in the first process."""

    job: TrainJob
    process: Process
    watch: Callback
    folder: RunFolder | None
    train: Batches
    val: Batches | None
    data_hash: str
    network: Network
    optimizer: torch.optim.Optimizer
    mean: ExponentialMovingAverage | None
    position: TrainState
    started: float = field(default_factory=time.monotonic)

    @property
    def total(self) -> int | None:
        """How many steps there will be; None where time alone limits them."""
        return self.job.recipe.total_steps(self.train.steps_per_pass)

    def progress(self) -> float:
        """The share of the run that is done, 0..1."""
        minutes = self.job.recipe.minutes
        by_steps = 0.0 if self.total is None else self.position.step / self.total
        by_time = 0.0 if minutes is None else self.position.seconds / (60 * minutes)
        return min(1.0, max(by_steps, by_time))


def train(job: TrainJob, watch: Callback | None = None) -> Outcome:
    """Train a network as asked, or go on with it; see `Recipe` for how, and `RunFolder` for what is written.

    Args:
        job: what is asked for.
        watch: told what happens; in the first process only.

    Raises:
        TrainingError: the folder holds something else, settings that do not fit, or losses that are not finite.
        DatasetError: no data set, a wrong hash, no objects, rows that cannot be read.
        MethodError: weights that do not fit, or no such device.
        StorageError: the disk refused.
    """
    with contextlib.ExitStack() as stack:
        process = stack.enter_context(joined(job.device))
        _fit_to_device(job.recipe, process.device)
        manifest = Manifest.read(job.data)
        others = [Manifest.read(folder) for folder in job.also]
        batches, val = _open_data(job, process, manifest)
        network = build_network(job.recipe, process, backbone=job.backbone, start=job.start)
        optimizer = build_optimizer(job.recipe, network, process.device)
        mean = ExponentialMovingAverage(network, job.recipe.ema_decay) if job.recipe.ema_decay else None
        folder = None
        if process.first:
            folder = stack.enter_context(opened(job.out, _settings(job, process, manifest, others), resume=job.resume))
        process.wait()
        position = TrainState()
        found = checkpoints(job.out / CHECKPOINTS) if job.resume else []
        if found:
            position = load_checkpoint(found[-1], network, optimizer, mean)
        if folder is not None:
            folder.cut(position.step)
        watch = watch if watch is not None and process.first else Callback()
        stack.callback(watch.close)
        data_hash = " + ".join(one.sha256 for one in (manifest, *others))
        run = Run(job, process, watch, folder, batches, val, data_hash, network, optimizer, mean, position)
        if run.progress() >= 1:
            return Outcome(position, finished=True)
        if val is None:
            watch.note("no validation: the last weights are kept, not the best")
        with GracefulStop() as stopping, contextlib.closing(_feed(run)) as feed:
            return _loop(run, feed, stopping)


def _loop(run: Run, feed: Iterator[Batch], stopping: GracefulStop) -> Outcome:
    recipe, process, device = run.job.recipe, run.process, run.process.device
    with stopping.kept_from_children():
        first = next(feed)  # starts the processes that read
    trial = prepare(first, recipe, step_generator(recipe.seed, run.position.step, process.rank, device))
    forward = process.shared(compiled(trained_form(run.network), recipe, trial.images, device, run.watch.note))
    parameters = list(run.network.parameters())
    window = MetricBuffer(process)
    before = run.position.seconds
    saved = lapped = time.monotonic()
    run.watch.start(run.position.step, run.total)
    for batch in itertools.chain([first], feed):
        # 1. How fast to learn, and what from: noise depends on the step's number alone.
        for group in run.optimizer.param_groups:
            group["lr"] = recipe.learning_rate_at(run.progress())
        generator = step_generator(recipe.seed, run.position.step, process.rank, device)
        prepared = prepare(batch, recipe, generator)
        # 2. Forward in the recipe's precision, losses in float32.
        with precision(recipe, device):
            output = forward(*prepared.images)
        losses = losses_of(output, prepared, recipe)
        # 3. Backward and one step.
        run.optimizer.zero_grad(set_to_none=True)
        losses["total"].backward()  # type: ignore[no-untyped-call]
        gradient = clip_grad_norm_(parameters, recipe.clip or float("inf"))
        run.optimizer.step()
        if run.mean is not None:
            run.mean.update()
        step = run.position.step + 1
        run.position = dataclasses.replace(run.position, step=step)
        window.add(step, batch.keys, losses, gradient)

        # 4. Every few steps: look at the losses, the clock, and what others want.
        alone = process.world_size == 1
        if not (
            step % recipe.log_every == 0
            or step % recipe.validate_every == 0
            or step == run.total
            or (alone and stopping.signal)
        ):
            continue
        steps, values = len(window), window.read()
        now = time.monotonic()
        speed = recipe.batch_size * steps / max(now - lapped, 1e-9)
        run.position = dataclasses.replace(run.position, seconds=process.largest(before + now - run.started))
        signal = int(process.largest(stopping.signal))
        ended = run.progress() >= 1
        _log(run, values, speed)
        # 5. Now and then: validate, and save.
        if run.val is not None and (step % recipe.validate_every == 0 or ended):
            _validate(run, run.val)
        if ended or signal or time.monotonic() - saved >= 60 * recipe.checkpoint_minutes:
            _save(run)
            saved = time.monotonic()
        if ended and run.val is None:
            _write_weights(run, None)
        if ended or signal:
            _draw(run)
            process.wait()
            return Outcome(run.position, finished=ended, signal=signal)
        lapped = time.monotonic()
    raise TrainingError("the data came to an end")  # batches are endless


def _fit_to_device(recipe: Recipe, device: torch.device) -> None:
    """Settings of torch itself that make a GPU fast; they change nothing on a CPU."""
    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
        if recipe.precision == "bf16":
            torch.set_float32_matmul_precision("high")


def _open_data(job: TrainJob, process: Process, manifest: Manifest) -> tuple[Batches, Batches | None]:
    recipe = job.recipe
    if recipe.batch_size % process.world_size:
        raise TrainingError(
            f"a batch of {recipe.batch_size} pairs cannot be shared by {process.world_size} processes: "
            "choose a multiple for --batch-size"
        )
    share = recipe.batch_size // process.world_size
    place: dict[str, Any] = {"size": recipe.size, "rank": process.rank, "world_size": process.world_size}
    train = Batches(
        open_joined((job.data, *job.also), "train"), share, seed=recipe.seed, workers=recipe.workers, **place
    )
    if recipe.validation_pairs == 0 or job.validate_on not in manifest.parts:
        return train, None
    return train, Batches(open_pairs(job.data, job.validate_on), share, seed=0, shuffle=False, **place)


def _feed(run: Run) -> Generator[Batch, None, None]:
    """Batches on the device from the run's step on."""
    batches = run.train.iterate(run.position.step)
    ahead = on_device(batches, run.process.device)
    try:
        yield from ahead
    finally:
        for one in (ahead, batches):
            if isinstance(one, Generator):
                one.close()


def _settings(job: TrainJob, process: Process, manifest: Manifest, others: Sequence[Manifest]) -> dict[str, Any]:
    """Everything that the weights depend on."""
    hashes: dict[str, Any] = {
        name: _hash(part) for name, part in manifest.parts.items() if name in ("train", job.validate_on)
    }
    if others:
        hashes["also"] = [_hash(other.parts["train"]) for other in others]
    return {
        "recipe_name": job.name,
        "recipe": job.recipe.to_dict(),
        "data": hashes,
        "backbone": None if job.backbone is None else hash_file(job.backbone),
        "start": None if job.start is None else hash_file(job.start),
        "processes": process.world_size,
        "version": __version__,
    }


def _hash(part: Part) -> str:
    return hashlib.sha256("\n".join(shard.sha256 for shard in part.shards).encode()).hexdigest()


def _log(run: Run, values: dict[str, float], speed: float) -> None:
    line = {
        "kind": "train",
        "step": run.position.step,
        "seconds": round(run.position.seconds, 3),
        "learning_rate": run.optimizer.param_groups[0]["lr"],
        "pairs_per_second": round(speed, 3),
        GRADIENT: values.pop(GRADIENT),
        "losses": values,
    }
    if run.folder is not None:
        run.folder.append(line)
    run.watch.line(run.position.step, run.progress(), line)


def _validate(run: Run, batches: Batches) -> None:
    """Validate; keep the weights if they are the best so far."""
    recipe, process = run.job.recipe, run.process
    count = -(-recipe.validation_pairs // recipe.batch_size)
    network = run.network if run.mean is None else run.mean.network
    with contextlib.closing(_first(batches, count)) as pairs:
        result = validate(network, pairs, recipe, process)
    best = run.position.best is None or result.score < run.position.best
    if best:
        run.position = dataclasses.replace(run.position, best=result.score)
        _write_weights(run, result)
    if run.folder is not None:
        run.folder.append(
            {"kind": "validation", "step": run.position.step, "seconds": round(run.position.seconds, 3)}
            | result.to_dict()
        )
        _draw(run)
    run.watch.validated(run.position.step, result, best)


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
            run.folder.checkpoints, run.network, run.optimizer, run.mean, run.position,
            keep=run.job.recipe.keep_checkpoints,
        )  # fmt: skip


def _write_weights(run: Run, result: Validation | None) -> None:
    """The weights to use, with everything that their card says in their header."""
    if run.folder is None:
        return
    recipe = run.job.recipe
    save_weights(
        run.folder.weights,
        run.network if run.mean is None else run.mean.network,
        {
            "variant": recipe.method,
            "size": list(recipe.size),
            "grouping": dataclasses.asdict(recipe.grouping),
            "recipe_name": run.job.name,
            "recipe": recipe.to_dict(),
            "data": run.data_hash,
            "step": run.position.step,
            "seconds": round(run.position.seconds, 1),
            "metrics": None if result is None else result.to_dict(),
        },
    )


def _draw(run: Run) -> None:
    if run.folder is not None:
        write_curve(run.folder.curve, read_metrics(run.folder.path), title=run.job.recipe.method)
