"""Overfit eight generated pairs: the shortest test that network, targets, losses and grouping fit together.

    python scripts/overfit.py [OUT] [--variant c-vl] [--steps 2200]

Generates small pairs and selects the first eight with at least two objects, all large enough to be extracted at the
size of training (about 38 pixels). Trains with the cpu recipe without augmentation, validates on the same pairs, and
reports whether the masked end-point error fell below 5 mm with all objects extracted. OUT/run/loss_curve.png shows
the progress. The same command continues a run that was stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

from objectflow.cli import main as objectflow
from objectflow.dataset import manifest as manifests
from objectflow.dataset.augment import AugmentSettings
from objectflow.dataset.manifest import Manifest, Shard
from objectflow.dataset.schema import PairRow
from objectflow.dataset.shards import open_pairs, write_shard
from objectflow.storage import files
from objectflow.training.callbacks import Terminal
from objectflow.training.job import TrainJob
from objectflow.training.loop import train
from objectflow.training.model_config import SceneFlowNetModel
from objectflow.training.recipes import find_recipe
from objectflow.training.validation import Validation

PAIRS = 8
"""Number of training pairs."""
GENERATED = 48
"""Number of generated pairs from which they are selected."""
SIZE = (96, 128)
"""Height and width of training images."""
MIN_PIXELS = 60
"""Minimum size of objects in the current frame at 160x120, about 38 pixels at the size of training."""
GOAL_CM = 0.5
"""Masked end-point error to reach."""


class GoalCheck(Terminal):
    """Records whether the goal is reached, and prints the CPU time."""

    def __init__(self) -> None:
        super().__init__()
        self.reached = False

    def validated(self, step: int, result: Validation, best: bool) -> None:
        """See `Callback`."""
        super().validated(step, result, best)
        print(f"  {time.process_time():.0f} s of CPU time", flush=True)
        self.reached = result.epe_cm < GOAL_CM and result.extracted == result.true_objects


def choose(source: Path, target: Path) -> None:
    """Write the first pairs whose objects are all large enough as a data set."""
    rows = [row for row in open_pairs(source) if _large(row)][:PAIRS]
    if len(rows) < PAIRS:
        raise SystemExit(f"only {len(rows)} of {GENERATED} pairs have only large objects")
    target.mkdir(parents=True, exist_ok=True)
    path = target / manifests.shard_name("train", 0, 1)
    write_shard(path, [row.to_dict() for row in rows], "pairs", {})
    shard = Shard(path.name, len(rows), path.stat().st_size, files.hash_file(path))
    manifest = Manifest.read(source)
    part = dataclasses.replace(manifest.parts["train"], rows=len(rows), scenes=len(rows), shards=(shard,))
    dataclasses.replace(manifest, parts={"train": part}).write(target)


def _large(row: PairRow) -> bool:
    counts = np.bincount(row.curr_labels.ravel())[1:]
    return bool((counts[counts > 0] >= MIN_PIXELS).all() and (counts > 0).sum() >= 2)


def run() -> int:
    """Generate the pairs, train, and print the result; 0 if the goal is reached."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path("objectflow_out/overfit"))
    parser.add_argument("--variant", choices=("s", "c", "c-vl"), default="c-vl")
    parser.add_argument("--steps", type=int, default=2200)
    parser.add_argument("--learning-rate", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    data = arguments.out / "data"
    if not (data / manifests.FILE).is_file():
        everything = str(arguments.out / "generated")
        code = objectflow(
            ["generate", "--out", everything, "--pairs", str(GENERATED), "--preset", "small", "--workers", "1"]
        )
        if code:
            return code
        choose(Path(everything), data)
    recipe = find_recipe("cpu", arguments.variant)
    # The recipe gives a radian the weight of a centimetre, so that noisy rotations do not dominate. Here every motion
    # can be learnt exactly, and an error of half a radian is two centimetres of flow.
    model = recipe.model
    assert isinstance(model, SceneFlowNetModel)
    recipe = dataclasses.replace(
        recipe,
        model=dataclasses.replace(model, loss=dataclasses.replace(model.loss, rotation=5.0, radius=50.0)),
        size=SIZE,
        batch_size=PAIRS,
        steps=arguments.steps,
        learning_rate=arguments.learning_rate,
        weight_decay=0.0,
        ema_decay=0.98,
        augment=AugmentSettings.nothing(),
        validate_every=200,
        validation_pairs=PAIRS,
        seed=arguments.seed,
    )
    check = GoalCheck()
    job = TrainJob("overfit", recipe, data, arguments.out / "run", resume=True, device="cpu", validate_on="train")
    train(job, check)
    print("reached" if check.reached else "not reached")
    return 0 if check.reached else 1


if __name__ == "__main__":
    sys.exit(run())
