"""`objectflow train`: train a network by a recipe; continued exactly where it was stopped."""

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
from objectflow.training.recipe import RECIPES, Recipe, find_recipe

EXAMPLES = """\
  objectflow train --recipe cpu --data data --out runs/c-vl
  objectflow train --recipe cpu --data data --out runs/c-vl --resume
  objectflow train --recipe gpu --data data --variant s --passes 12 --batch-size 64
  objectflow train --recipe gpu --data data --network.reach 8 --loss.squared --augment.zoom 1.5
  objectflow train --recipe gpu --data data --also wild --variant rigidmatch --out runs/rigidmatch
  torchrun --nproc-per-node 4 -m objectflow train --recipe gpu --data data --out runs/c-vl
"""


@dataclass(frozen=True)
class Train:
    """Train a network on generated pairs.

    Writes settings.json, metrics.jsonl, loss_curve.png, checkpoints and weights.safetensors (the best by validation).
    Ctrl-C or SIGTERM finish the step and save; the same command with --resume goes on as if nothing had happened.
    Every field of the recipe is an option; the defaults shown are the recipe's own.
    """

    data: Annotated[Path, option("DIR")]
    """Data set from `objectflow generate`, with the split train, and val for validation."""

    also: Annotated[tuple[Path, ...], option("DIR [DIR ...]", "")] = ()
    """More data sets: pairs of their split train are mixed in, each as often as any other. Validation stays with
    --data."""

    recipe: Annotated[str, option("NAME", "cpu")] = "cpu"
    """paper, gpu or cpu."""

    out: Annotated[Path | None, option("DIR", "objectflow_out/train-VARIANT-RECIPE")] = None
    """Folder of the run, new or empty; with --resume, that of the same run."""

    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Go on from the last checkpoint in --out; start anew if there is none."""

    device: str = "auto"
    """auto, cpu, cuda or cuda:N."""

    backbone_weights: Annotated[Path | None, option("FILE")] = None
    """torchvision's resnet50 state dict for the colour trunk (network.trunk-width 64, network.trunk-blocks 3 4)."""

    start_from: Annotated[Path | None, option("FILE")] = None
    """Weights of an earlier run of the same network to start from."""

    settings: Annotated[Recipe, tyro.conf.arg(name="")] = RECIPES["cpu"]

    def run(self) -> None:
        """Train, and say how it went on."""
        from objectflow.training.callbacks import Several, TensorBoard, Terminal
        from objectflow.training.loop import TrainJob, train
        from objectflow.training.parallel import is_first
        from objectflow.training.run_folder import WEIGHTS

        find_recipe(self.recipe)
        out = self.out or OUTPUT_ROOT / f"train-{self.settings.variant}-{self.recipe}"
        check_not_below_a_file(out)
        if out.exists() and not out.is_dir():
            raise TrainingError(f"{out} is a file, not a folder: name another --out")
        job = TrainJob(
            name=self.recipe,
            recipe=self.settings,
            data=self.data,
            out=out,
            also=self.also,
            resume=self.resume,
            device=self.device,
            backbone=self.backbone_weights,
            start=self.start_from,
        )
        outcome = train(job, Several(Terminal(), TensorBoard(out / "tensorboard")) if is_first() else None)
        if not is_first():
            return
        if outcome.finished:
            print(f"{outcome.position.step} steps, {outcome.position.seconds:.0f} s; weights: {out / WEIGHTS}")
            return
        words = [word for word in sys.argv[1:] if word != "--resume"]
        print(f"stopped after step {outcome.position.step}; go on with: objectflow {shlex.join(words)} --resume")
        raise SystemExit(128 + outcome.signal)


def default(words: Sequence[str]) -> Train:
    """The arguments that are not typed, for the recipe that is: its fields show as the options' defaults.

    Raises:
        TrainingError: an unknown recipe.
    """
    name = "cpu"
    for index, word in enumerate(words):
        if word == "--recipe" and index + 1 < len(words):
            name = words[index + 1]
        elif word.startswith("--recipe="):
            name = word.removeprefix("--recipe=")
    return Train(data=tyro.MISSING, recipe=name, settings=find_recipe(name))
