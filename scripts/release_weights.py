"""Make released weights from scratch: generate data, train every network, evaluate, and release the best.

    python scripts/release_weights.py --out release                         # one GPU: hours
    python scripts/release_weights.py --out release --recipe cpu --pairs 2000 --val-pairs 128 --test-pairs 200 \
        --variants c-vl --minutes 90 --device cpu
    python scripts/release_weights.py --pack run/weights.safetensors --tables evaluation/tables.md

The last command releases weights that were trained before, with tables written by `objectflow evaluate`. Weights of
`rigidmatch` go into the package, those of the paper's network into the folder `weights` of the repository.

Each step is a command of `objectflow` that can also be run by hand; all of them are printed. The script can be run
again after an interruption: every step continues its own work and skips what is done.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import tyro

from objectflow.methods.find_weights import packaged_folder
from objectflow.networks.rigidmatch import RigidMatchSettings
from objectflow.networks.weights import load_network, read_header, save_weights
from objectflow.storage import files
from objectflow.storage.files import hash_file
from objectflow.training.model_config import VARIANTS, Variant

PAPER = Path(__file__).resolve().parents[1] / "weights"
"""Folder of the released weights of the paper's network; those of `rigidmatch` come with the package."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Generates data, trains and evaluates the networks, and packs the best weights with their card."""

    out: Path = Path("release")
    """Folder of the data set, the runs and the tables; new, or that of an earlier call."""
    recipe: str = "gpu"
    """Recipe of `objectflow train`."""
    variants: tuple[Variant, ...] = VARIANTS
    """Networks to train. Released are rigidmatch and the paper's network with the lowest validation error."""
    pairs: int = 25_000
    """Training pairs."""
    clutter_pairs: int = 25_000
    """Additional training pairs of the preset clutter for rigidmatch; 0 for none."""
    val_pairs: int = 1_000
    """Validation pairs."""
    test_pairs: int = 1_000
    """Test pairs for the tables."""
    views: int = 1
    """Cameras per scene; pairs of more cameras are faster to generate, but less diverse."""
    samples: Literal[1, 4] = 4
    """Colour samples per pixel of generated images."""
    passes: float = 12.0
    """Number of passes over the training pairs."""
    minutes: float | None = None
    """Training time of each network; replaces passes."""
    workers: int = 2
    """Processes that generate data, and that read it in training."""
    device: str = "auto"
    """Device of rendering and training: auto, cpu or cuda."""
    classical: tuple[str, ...] = ("zero", "dense-flow", "consensus")
    """Methods without weights for the tables."""
    ship: bool = True
    """Write the best weights into the package and the folder weights; otherwise only print which they are."""
    pack: Path | None = None
    """Only release these weights."""
    tables: Path | None = None
    """With --pack: the tables.md of their evaluation, for the card."""
    size: tuple[int, int] | None = None
    """With --pack: height and width to which frames are resized, if not those of training."""
    queries: int | None = None
    """With --pack: number of queries of rigidmatch, if not that of training."""
    history: str = ""
    """With --pack: a sentence for the card about earlier runs from which the training started."""
    credits: tuple[Path, ...] = ()
    """With --pack: the credits.json of the data sets, whose meshes the card lists with their authors and licences."""


def main(settings: Settings) -> None:
    """Generate data, train, evaluate, and pack the best weights."""
    import torch

    if settings.pack is not None:
        tables = "" if settings.tables is None else settings.tables.read_text(encoding="utf-8")
        pack(settings.pack, tables, settings.history, settings.size, settings.queries, settings.credits)
        return
    device = settings.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    data, clutter = settings.out / "data", settings.out / "clutter"
    for split, count in (("train", settings.pairs), ("val", settings.val_pairs), ("test", settings.test_pairs)):
        generate(settings, data, "paper", split, count, device)
    if "rigidmatch" in settings.variants and settings.clutter_pairs:
        generate(settings, clutter, "clutter", "train", settings.clutter_pairs, device)
    for variant in settings.variants:
        length = ["--passes", settings.passes] if settings.minutes is None else ["--minutes", settings.minutes]
        run(
            "train", "--recipe", settings.recipe, "--variant", variant, "--data", data, "--device", device,
            "--out", settings.out / f"train-{variant}", "--workers", settings.workers, *length, "--resume",
            *(("--extra-data", clutter) if variant == "rigidmatch" and settings.clutter_pairs else ()),
        )  # fmt: skip
    run("evaluate", "--data", data, "--methods", *methods(settings, device), "--out", settings.out / "tables")
    tables = (settings.out / "tables" / "tables.md").read_text(encoding="utf-8")
    for best in chosen(settings):
        print(f"best by validation: {best}")
        if settings.ship:
            pack(weights_of(settings, best), tables)


def generate(settings: Settings, folder: Path, preset: str, split: str, count: int, device: str) -> None:
    """Generate one split, or continue its generation."""
    views = settings.views if split == "train" else 1
    run(
        "generate", "--out", folder, "--preset", preset, "--split", split, "--pairs", count,
        "--views", views, "--samples", settings.samples, "--workers", settings.workers, "--device", device,
    )  # fmt: skip


def chosen(settings: Settings) -> list[Variant]:
    """The variants to release: the best of the paper's networks, and rigidmatch."""
    papers = [variant for variant in settings.variants if variant != "rigidmatch"]
    best = sorted(papers, key=lambda variant: validation_error(weights_of(settings, variant)))[:1]
    return [*best, *(variant for variant in settings.variants if variant == "rigidmatch")]


def run(*words: object) -> None:
    """Run a command of objectflow, and exit with its code if it fails."""
    command = [sys.executable, "-m", "objectflow", *map(str, words)]
    print(f"$ {shlex.join(['objectflow', *command[3:]])}", flush=True)
    done = subprocess.run(command, check=False)
    if done.returncode:
        raise SystemExit(done.returncode)


def weights_of(settings: Settings, variant: Variant) -> Path:
    """The weights that the training of a variant writes."""
    return settings.out / f"train-{variant}" / "weights.safetensors"


def methods(settings: Settings, device: str) -> list[str]:
    """The rows of the tables: the classical methods, and each network per pixel, per object, and refined."""
    rows = list(settings.classical)
    for variant in settings.variants:
        name = variant if variant == "rigidmatch" else f"sceneflownet-{variant}"
        for rigid in ("none", "solve" if variant == "rigidmatch" else "average", "refine"):
            options = f"weights={weights_of(settings, variant)},rigid={rigid},device={device},camera=static"
            rows.append(f"{name}+{rigid}={name}:{options}")
    return rows


def validation_error(weights: Path) -> float:
    """Masked end-point error on the validation split, cm."""
    metrics: dict[str, Any] = read_header(weights)[1].get("metrics") or {}
    return float(metrics.get("epe_cm", float("inf")))


def pack(
    weights: Path,
    tables: str,
    history: str = "",
    size: tuple[int, int] | None = None,
    queries: int | None = None,
    credits: Sequence[Path] = (),
) -> None:
    """Write weights in half precision to their folder of released weights, with their card and their hash."""
    network, metadata = load_network(weights)
    if queries is not None:
        if not isinstance(network.settings, RigidMatchSettings):
            raise SystemExit(f"{weights}: this network has no object queries")
        network, metadata = load_network(weights, settings=dataclasses.replace(network.settings, queries=queries))
    if size is not None:
        metadata["size"] = list(size)
    name = metadata["variant"]
    target = (packaged_folder() if name == "rigidmatch" else PAPER) / f"{name}.safetensors"
    target.parent.mkdir(exist_ok=True)
    if name != "rigidmatch":
        for old in target.parent.glob("sceneflownet-*.safetensors"):
            old.unlink()
            old.with_suffix(".md").unlink(missing_ok=True)
    save_weights(target, network, metadata, half=True)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    text = card(metadata, target, parameters, tables, history) + mesh_credits(credits)
    files.write_text(target.with_suffix(".md"), text)
    print(f"written: {target} and its card")


def card(metadata: dict[str, Any], target: Path, parameters: int, tables: str, history: str) -> str:
    """The model card, from the metadata of the weights and the tables."""
    recipe, minutes = metadata["recipe"], metadata["seconds"] / 60
    (trained_height, trained_width), (height, width) = recipe["size"], metadata["size"]
    fields = ", ".join(f"`{key}` {value}" for key, value in recipe.items() if not isinstance(value, dict))
    return f"""# {metadata["variant"]}

| | |
|---|---|
| file | `{target.name}`, {target.stat().st_size / 2**20:.1f} MiB, float16 |
| sha256 | `{hash_file(target)}` |
| parameters | {parameters:,} |
| size | trained at {trained_width}x{trained_height}; frames are resized to the number of pixels of {width}x{height} |
| recipe | `{metadata["recipe_name"]}`, stopped at step {metadata["step"]:,} after {minutes:.0f} minutes |
| data | simulated pairs, sha256 of the data set `{metadata["data"]}` |
| validation | {json.dumps(metadata["metrics"])} |

Recipe: {fields}. {history}

## Measured

{tables.strip()}

## Limits

{LIMITS["rigidmatch" if metadata["variant"] == "rigidmatch" else "sceneflownet"]}
"""


def mesh_credits(paths: Sequence[Path]) -> str:
    """A section of the card: titles, authors and licences of the meshes that data sets show, one line per author."""
    models: dict[str, dict[str, str]] = {}
    for path in paths:
        models |= json.loads(path.read_text(encoding="utf-8"))
    titles: dict[tuple[str, str], set[str]] = {}
    for model in models.values():
        titles.setdefault((model["author"], model["license"]), set()).add(model["title"])
    if not titles:
        return ""
    lines = (f"- {author} ({license_}): {', '.join(sorted(names))}" for (author, license_), names in titles.items())
    sources = ", ".join(sorted({model["source"].partition(",")[0] for model in models.values()}))
    intro = f"The training data show these models ({sources}):"
    return "\n## Models in the training data\n\n" + intro + "\n\n" + "\n".join(sorted(lines)) + "\n"


LIMITS = {
    "sceneflownet": """\
Trained on simulated scenes only: everyday objects that fall close together onto a floor, seen from 0.2 to 0.8 m by a
static camera. Everything in such a scene moves. On a table where most objects are static, `consensus` is the safer
choice: in real scenes the network may label most of the scene as moving, in many pieces. Thin, transparent and
mirroring objects are not in the training data.""",
    "rigidmatch": """\
Trained on simulated scenes only: falling piles, in which everything is an object, and tables, floors and bins on which
a few objects move and the rest is static. Small distant objects cover few cells of its grid and are missed. Thin,
transparent and mirroring objects, people and hands are not in the training data.""",
}


if __name__ == "__main__":
    main(tyro.cli(Settings))
