"""From nothing to released weights: generate, train every network, evaluate, and release the best.

    python scripts/release_weights.py --out release                         # one GPU: hours
    python scripts/release_weights.py --out release --recipe cpu --pairs 2000 --val-pairs 128 --test-pairs 200 \
        --variants c-vl --minutes 90 --device cpu
    python scripts/release_weights.py --pack run/weights.safetensors --tables evaluation/tables.md

The last one releases weights that other commands trained, with tables that `objectflow evaluate` wrote for them.
Those of `rigidmatch` go into the package, the paper's network's into the folder `weights` of the repository.

Each step is a command of `objectflow` that can be run by hand; all of them are printed. Run again after it was
stopped, it goes on where it was: every step continues its own work and skips what is done.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import tyro

from objectflow.methods.find_weights import packaged_folder
from objectflow.networks.weights import load_network, read_header, save_weights
from objectflow.storage import files
from objectflow.storage.files import hash_file

Variant = Literal["s", "c", "c-vl", "rigidmatch"]
PAPER = Path(__file__).resolve().parents[1] / "weights"
"""Where the paper's network's weights are released; `rigidmatch`'s come with the package."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Generates data, trains, evaluates and packs the best weights with their card."""

    out: Path = Path("release")
    """Folder of the data set, the runs and the tables; new, or of an earlier call."""
    recipe: str = "gpu"
    """Of `objectflow train`."""
    variants: tuple[Variant, ...] = ("s", "c", "c-vl", "rigidmatch")
    """Which networks to train. Shipped are rigidmatch, and the one of the paper's with the lowest validation error."""
    pairs: int = 25_000
    """Training pairs."""
    wild_pairs: int = 25_000
    """More training pairs, of the preset wild, for rigidmatch; 0 for none."""
    val_pairs: int = 1_000
    """Validation pairs."""
    test_pairs: int = 1_000
    """Test pairs for the tables."""
    views: int = 1
    """Cameras a scene: more are cheaper, and more alike."""
    samples: Literal[1, 4] = 4
    """Colour samples a pixel of generated images."""
    passes: float = 12.0
    """How often each training pair is used."""
    minutes: float | None = None
    """Stop each training after so much time instead."""
    workers: int = 2
    """Processes that generate data, and that read it in training."""
    device: str = "auto"
    """Where pictures are rendered and networks trained: auto, cpu or cuda."""
    classical: tuple[str, ...] = ("zero", "dense-flow", "consensus")
    """Methods without weights for the tables."""
    ship: bool = True
    """Write the best weights into the package and the folder weights; otherwise only say which they are."""
    pack: Path | None = None
    """Only put these weights where they are released."""
    tables: Path | None = None
    """With `pack`: the tables.md of their evaluation, for the card."""
    size: tuple[int, int] | None = None
    """With `pack`: height and width that frames are brought to, where another size than training's proved better."""
    queries: int | None = None
    """With `pack`: how many objects rigidmatch looks for, where more than in training proved better."""
    history: str = ""
    """With `pack`: what came before these weights' own run, in a sentence for the card."""


def main(settings: Settings) -> None:
    """Generate, train, evaluate, pack."""
    import torch

    if settings.pack is not None:
        tables = "" if settings.tables is None else settings.tables.read_text(encoding="utf-8")
        pack(settings.pack, tables, settings.history, settings.size, settings.queries)
        return
    device = settings.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    data, wild = settings.out / "data", settings.out / "wild"
    for split, count in (("train", settings.pairs), ("val", settings.val_pairs), ("test", settings.test_pairs)):
        generate(settings, data, "paper", split, count, device)
    if "rigidmatch" in settings.variants and settings.wild_pairs:
        generate(settings, wild, "wild", "train", settings.wild_pairs, device)
    for variant in settings.variants:
        length = ["--passes", settings.passes] if settings.minutes is None else ["--minutes", settings.minutes]
        run(
            "train", "--recipe", settings.recipe, "--variant", variant, "--data", data, "--device", device,
            "--out", settings.out / f"train-{variant}", "--workers", settings.workers, *length, "--resume",
            *(("--also", wild) if variant == "rigidmatch" and settings.wild_pairs else ()),
        )  # fmt: skip
    run("evaluate", "--data", data, "--methods", *methods(settings, device), "--out", settings.out / "tables")
    tables = (settings.out / "tables" / "tables.md").read_text(encoding="utf-8")
    for best in chosen(settings):
        print(f"best by validation: {best}")
        if settings.ship:
            pack(weights_of(settings, best), tables)


def generate(settings: Settings, folder: Path, preset: str, split: str, count: int, device: str) -> None:
    """Make one split, or go on with it."""
    views = settings.views if split == "train" else 1
    run(
        "generate", "--out", folder, "--preset", preset, "--split", split, "--pairs", count,
        "--views", views, "--samples", settings.samples, "--workers", settings.workers, "--device", device,
    )  # fmt: skip


def chosen(settings: Settings) -> list[Variant]:
    """What is shipped: the best of the paper's networks, and rigidmatch."""
    papers = [variant for variant in settings.variants if variant != "rigidmatch"]
    best = sorted(papers, key=lambda variant: validation_error(weights_of(settings, variant)))[:1]
    return [*best, *(variant for variant in settings.variants if variant == "rigidmatch")]


def run(*words: object) -> None:
    """Run a verb of objectflow and stop with its exit code if it fails."""
    command = [sys.executable, "-m", "objectflow", *map(str, words)]
    print(f"$ {shlex.join(['objectflow', *command[3:]])}", flush=True)
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise SystemExit(done.returncode)


def weights_of(settings: Settings, variant: Variant) -> Path:
    """What training a variant writes."""
    return settings.out / f"train-{variant}" / "weights.safetensors"


def methods(settings: Settings, device: str) -> list[str]:
    """Every row of the tables: the classical ones, and each network by pixels, by objects, and refined."""
    rows = list(settings.classical)
    for variant in settings.variants:
        name = variant if variant == "rigidmatch" else f"sceneflownet-{variant}"
        for rigid in ("none", "solve" if variant == "rigidmatch" else "average", "refine"):
            options = f"weights={weights_of(settings, variant)},rigid={rigid},device={device},camera=static"
            rows.append(f"{name}+{rigid}={name}:{options}")
    return rows


def validation_error(weights: Path) -> float:
    """Masked end-point error on the validation split, centimetres."""
    metrics: dict[str, Any] = read_header(weights)[1].get("metrics") or {}
    return float(metrics.get("epe_cm", float("inf")))


def pack(
    weights: Path, tables: str, history: str = "", size: tuple[int, int] | None = None, queries: int | None = None
) -> None:
    """Write the weights in half precision where they are released, with their card and their hash."""
    network, about = load_network(weights)
    if queries is not None:
        network, about = load_network(weights, settings=dataclasses.replace(network.settings, queries=queries))
    if size is not None:
        about["size"] = list(size)
    name = about["variant"]
    target = (packaged_folder() if name == "rigidmatch" else PAPER) / f"{name}.safetensors"
    target.parent.mkdir(exist_ok=True)
    if name != "rigidmatch":
        for old in target.parent.glob("sceneflownet-*.safetensors"):
            old.unlink()
            old.with_suffix(".md").unlink(missing_ok=True)
    save_weights(target, network, about, half=True)
    files.write_text(
        target.with_suffix(".md"),
        card(about, target, sum(one.numel() for one in network.parameters()), tables, history),
    )
    print(f"written: {target} and its card")


def card(about: dict[str, Any], target: Path, parameters: int, tables: str, history: str) -> str:
    """What somebody who uses the weights should know, all of it from the file itself and the tables."""
    recipe = about["recipe"]
    (trained_height, trained_width), (height, width) = recipe["size"], about["size"]
    fields = ", ".join(f"`{key}` {value}" for key, value in recipe.items() if not isinstance(value, dict))
    return f"""# {about["variant"]}

| | |
|---|---|
| file | `{target.name}`, {target.stat().st_size / 2**20:.1f} MiB, float16 |
| sha256 | `{hash_file(target)}` |
| parameters | {parameters:,} |
| size | trained at {trained_width}x{trained_height}; frames are brought to as many pixels as {width}x{height} has |
| recipe | `{about["recipe_name"]}`, stopped at step {about["step"]:,} after {about["seconds"] / 60:.0f} minutes |
| data | simulated pairs, sha256 of the data set `{about["data"]}` |
| validation | {json.dumps(about["metrics"])} |

Recipe: {fields}. {history}

## Measured

{tables.strip()}

## Limits

{LIMITS["rigidmatch" if about["variant"] == "rigidmatch" else "sceneflownet"]}
"""


LIMITS = {
    "sceneflownet": """\
Trained on simulated scenes alone: everyday objects that fall close together onto a floor, seen from 0.2 to 0.8 m by
a camera that stands still. Everything in such a scene moves; on a table where most things stand still, `consensus` is
the safer choice: on a real one the network may call most of the scene moving, in many pieces. Thin, transparent and
mirroring things were never seen.""",
    "rigidmatch": """\
Trained on simulated scenes alone: falling piles, where everything counts as an object, and tables, floors and bins on
which a few things move and the rest stands still. Small things far away cover few cells of its grid and are missed.
Thin, transparent and mirroring things were never seen, nor people and hands.""",
}


if __name__ == "__main__":
    main(tyro.cli(Settings))
