"""`objectflow train`: train a network by a recipe; a stopped run is continued exactly."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from objectflow.cli.arguments import option
from objectflow.cli.output import OUTPUT_ROOT, check_not_below_a_file
from objectflow.errors import TrainingError
from objectflow.training.model_config import Variant
from objectflow.training.recipe import Recipe
from objectflow.training.recipes import RECIPES, find_recipe

EXAMPLES = """\
  objectflow train --recipe cpu --data data --out runs/c-vl
  objectflow train --recipe cpu --data data --out runs/c-vl --resume
  objectflow train --recipe gpu --data data --variant s --passes 12 --batch-size 64
  objectflow train --recipe gpu --data data --model.network.reach 8 --model.loss.squared --augment.zoom 1.5
  objectflow train --recipe gpu --data data --extra-data clutter --variant rigidmatch --out runs/rigidmatch
  objectflow train --recipe cpu --data data --variant rigidmatch --model.network.queries 64 --model.loss.match 1
  torchrun --nproc-per-node 4 -m objectflow train --recipe gpu --data data --out runs/c-vl
"""


@dataclass(frozen=True)
class Train:
    """Train a network on generated pairs.

    Writes settings.json, metrics.jsonl, loss_curve.png, checkpoints and weights.safetensors (the best by validation).
    Ctrl-C or SIGTERM finish the step and save a checkpoint; the same command with --resume continues the run exactly.
    Every field of the recipe is an option; the options and defaults shown are those of the chosen --recipe and
    --variant: `objectflow train --variant rigidmatch --help` lists those of rigidmatch.
    """

    data: Annotated[Path, option("DIR")]
    """Data set from `objectflow generate`, with the split train, and val for validation."""

    extra_data: Annotated[tuple[Path, ...], option("DIR [DIR ...]", "")] = ()
    """More data sets, whose pairs of the split train are mixed in with equal weight. Validation uses --data alone."""

    recipe: Annotated[str, option("NAME", "cpu")] = "cpu"
    """paper, gpu or cpu."""

    variant: Variant = "c-vl"
    """The network and its losses, which are the --model options. s: the paper's network without correlation; c: with
    correlation; c-vl: c with variance and violation losses; rigidmatch: the network of the method rigidmatch."""

    out: Annotated[Path | None, option("DIR", "objectflow_out/train-VARIANT-RECIPE")] = None
    """Folder of the run, new or empty; with --resume, that of the same run."""

    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Continue from the last checkpoint in --out; start anew if there is none."""

    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    backbone_weights: Annotated[Path | None, option("FILE")] = None
    """torchvision's resnet50 state dict for the colour trunk (model.network.trunk-width 64, trunk-blocks 3 4)."""

    start_from: Annotated[Path | None, option("FILE")] = None
    """Weights of an earlier run of the same network to start from."""

    settings: Annotated[Recipe, tyro.conf.arg(name=""), tyro.conf.AvoidSubcommands] = RECIPES["cpu"]

    def run(self) -> None:
        """Train, and print the result or the command that continues the run."""
        from objectflow.runtime.devices import find_device
        from objectflow.training.callbacks import CallbackList, TensorBoard, Terminal
        from objectflow.training.job import TrainJob
        from objectflow.training.loop import train
        from objectflow.training.parallel import is_first
        from objectflow.training.run_folder import WEIGHTS

        if self.recipe != "cpu" and find_device(self.device).type == "cpu" and is_first():
            note = f"no GPU is used: the recipe {self.recipe} takes days on a CPU; --recipe cpu is made for one"
            print(f"objectflow: warning: {note}", file=sys.stderr)

        out = self.out or OUTPUT_ROOT / f"train-{self.settings.model.variant}-{self.recipe}"
        check_not_below_a_file(out)
        if out.exists() and not out.is_dir():
            raise TrainingError(f"{out} is a file, not a folder: name another --out")
        job = TrainJob(
            name=self.recipe,
            recipe=self.settings,
            data=self.data,
            out=out,
            extra_data=self.extra_data,
            resume=self.resume,
            device=self.device,
            backbone=self.backbone_weights,
            start=self.start_from,
        )
        outcome = train(job, CallbackList(Terminal(), TensorBoard(out / "tensorboard")) if is_first() else None)
        if not is_first():
            return
        if outcome.finished:
            print(f"{outcome.state.step} steps, {outcome.state.seconds:.0f} s; weights: {out / WEIGHTS}")
            return
        words = [word for word in sys.argv[1:] if word != "--resume"]
        print(f"stopped after step {outcome.state.step}; continue with: objectflow {shlex.join(words)} --resume")
        raise SystemExit(128 + outcome.signal)


def default(words: Sequence[str]) -> Train:
    """The arguments with the typed recipe and variant, whose fields become the defaults of the options.

    Raises:
        TrainingError: an unknown recipe or variant.
    """
    recipe = _typed(words, "--recipe", "cpu")
    variant = _typed(words, "--variant", "c-vl")
    settings = find_recipe(recipe, variant)
    return Train(data=tyro.MISSING, recipe=recipe, variant=settings.model.variant, settings=settings)


def _typed(words: Sequence[str], name: str, default: str) -> str:
    """The last typed value of an option."""
    value = default
    for index, word in enumerate(words):
        if word == name and index + 1 < len(words):
            value = words[index + 1]
        elif word.startswith(f"{name}="):
            value = word.removeprefix(f"{name}=")
    return value
