"""Make the set of 16 pairs that comes with the package: `python scripts/make_tiny_set.py`.

It has test objects in small scenes at the paper's resolution. All images are recompressed with the best PNG settings,
without loss, so that the set is smaller than 3 MB.
"""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from objectflow.dataset.manifest import Manifest, Part, Shard, shard_name
from objectflow.dataset.shards import open_pairs, write_shard
from objectflow.evaluation.data.sources import TINY_FOLDER
from objectflow.runtime.pool import InProcess
from objectflow.storage.files import hash_file
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.synth.generation.paper_maker import PaperScenes
from objectflow.synth.scenes.paper_scene import SceneSettings

SPLIT = "test"
LIMIT = 3_000_000
"""Maximum size of the folder, bytes."""


@dataclasses.dataclass
class Settings:
    """Makes the tiny set."""

    out: Path = TINY_FOLDER
    """Output folder; it is replaced."""
    pairs: int = 16
    """Number of pairs."""
    objects: tuple[int, int] = (1, 9)
    """Minimum and maximum number of objects per scene."""
    seed: int = 16
    """Random seed; it differs from that of the test sets, which have the same objects in other scenes."""


def main(settings: Settings) -> None:
    """Generate in a temporary folder, recompress, and replace the output folder."""
    scene = SceneSettings(objects=settings.objects)
    recorded = {"preset": "tiny", "samples": 4, "objects": list(settings.objects)}
    pool = InProcess(PaperScenes(seed=settings.seed, split=SPLIT, settings=scene))
    with tempfile.TemporaryDirectory() as folder:
        job = GenerationJob("pairs", SPLIT, settings.pairs, 1)
        made = generate(Path(folder) / "set", [job], pool, seed=settings.seed, settings=recorded)
        pool.close()
        if made is None:
            raise SystemExit("the generator made no manifest")
        rows = [pack(row.to_dict()) for row in open_pairs(Path(folder) / "set", SPLIT)]
    shutil.rmtree(settings.out, ignore_errors=True)
    settings.out.mkdir(parents=True)
    path = settings.out / shard_name(SPLIT, 0, 1)
    write_shard(path, rows, "pairs", {"seed": settings.seed, "settings": recorded})
    shard = Shard(path.name, len(rows), path.stat().st_size, hash_file(path))
    part = Part("pairs", SPLIT, len(rows), len(rows), 1, made.parts[SPLIT].rejected, (shard,))
    Manifest(settings.seed, recorded, {SPLIT: part}, made.objectflow).write(settings.out)
    size = sum(file.stat().st_size for file in settings.out.iterdir())
    print(f"{settings.out}: {len(rows)} pairs, {size} bytes")
    if size >= LIMIT:
        raise SystemExit(f"more than {LIMIT} bytes: choose fewer --objects")


def pack(row: dict[str, Any]) -> dict[str, Any]:
    """The row with recompressed PNGs."""
    return {name: pack_png(value) if isinstance(value, bytes) else value for name, value in row.items()}


def pack_png(data: bytes) -> bytes:
    """The smallest PNG of an image over all strategies of the encoder."""
    image = decode(data)
    strategies = range(cv2.IMWRITE_PNG_STRATEGY_DEFAULT, cv2.IMWRITE_PNG_STRATEGY_FIXED + 1)
    options = [[cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, strategy] for strategy in strategies]
    packed = min((cv2.imencode(".png", image, option)[1].tobytes() for option in options), key=len)
    if not np.array_equal(decode(packed), image):
        raise SystemExit("the PNG encoder changed a pixel")
    return packed


def decode(data: bytes) -> NDArray[Any]:
    """The image of a PNG file, with its channels in the file's order."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


if __name__ == "__main__":
    main(tyro.cli(Settings))
