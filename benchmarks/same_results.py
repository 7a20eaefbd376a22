"""Whether two versions of the package give the same results, method by method and pair by pair.

    python benchmarks/same_results.py write before --pairs recordings   # with the one version installed
    python benchmarks/same_results.py write after --pairs recordings    # with the other
    python benchmarks/same_results.py compare before after

The pairs are the 16 of the packaged set and the pair folders below `--pairs`. Only the public interface is used: the
script runs with versions whose modules lie elsewhere.
"""

from __future__ import annotations

import dataclasses
import io
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from objectflow import Camera, RgbdFrame, SceneMotion

Pair = tuple[str, RgbdFrame, RgbdFrame]


@dataclasses.dataclass(frozen=True)
class Write:
    """Runs every method on every pair and keeps labels, motions and flow."""

    out: tyro.conf.Positional[Path]
    """Folder for one .npz file a method and pair; those that exist are kept."""
    pairs: Path | None = None
    """Folder whose subfolders are pair folders."""
    methods: tuple[str, ...] = tuple(
        name for name in objectflow.METHODS if name not in ("sceneflownet-s", "sceneflownet-c")
    )
    """Names of methods; those of the paper's networks need OBJECTFLOW_WEIGHTS."""

    def run(self) -> None:
        """Write what is missing."""
        self.out.mkdir(parents=True, exist_ok=True)
        pairs = [*packaged_pairs(), *(folder_pairs(self.pairs) if self.pairs else [])]
        for method in self.methods:
            estimator = objectflow.load(method)
            for name, prev, curr in pairs:
                file = self.out / f"{method}--{name}.npz"
                if not file.exists():
                    np.savez_compressed(file, **numbers(estimator(prev, curr)))


@dataclasses.dataclass(frozen=True)
class Compare:
    """Prints the largest differences between two folders; exit code 1 where they exceed the tolerance."""

    first: tyro.conf.Positional[Path]
    second: tyro.conf.Positional[Path]
    tolerance: float = 1e-6
    """Largest difference of a motion's entries, and of flow in metres."""

    def run(self) -> None:
        """Compare what both folders hold."""
        table = Table("method", "pairs", "other labels, pixels", "motions, largest difference", "flow, m")
        worst: dict[str, list[float]] = {}
        for file in sorted(self.first.glob("*.npz")):
            other = self.second / file.name
            if not other.exists():
                sys.exit(f"{other} is missing: run `write` to its end first")
            rows = worst.setdefault(file.name.split("--")[0], [0, 0, 0, 0])
            rows[0] += 1
            for column, value in enumerate(differences(dict(np.load(file)), dict(np.load(other))), start=1):
                rows[column] = max(rows[column], value)
        for method, (count, labels, motions, flow) in worst.items():
            table.add_row(method, str(int(count)), f"{labels:g}", f"{motions:.2g}", f"{flow:.2g}")
        Console().print(table)
        if any(max(row[1:]) > self.tolerance for row in worst.values()):
            sys.exit(1)


def packaged_pairs() -> list[Pair]:
    """The pairs that come with the package."""
    pairs: list[Pair] = []
    for file in sorted((Path(objectflow.__file__).parent / "evaluation" / "tiny").glob("*.parquet")):
        for row in pq.read_table(file).to_pylist():
            camera = Camera.from_dict(row["camera"])
            frames = (
                RgbdFrame(
                    color=decoded(row[f"{end}_color"])[..., ::-1].copy(),
                    depth=(decoded(row[f"{end}_depth"]) / np.float32(row["camera"]["depth_scale"])).astype(np.float32),
                    camera=camera,
                )
                for end in ("prev", "curr")
            )
            pairs.append((row["key"], *frames))
    return pairs


def decoded(data: bytes) -> Any:
    """The image of a PNG file's bytes."""
    return cv2.imdecode(np.frombuffer(io.BytesIO(data).read(), np.uint8), cv2.IMREAD_UNCHANGED)


def folder_pairs(folder: Path) -> list[Pair]:
    """The pair folders below a folder."""
    pairs: list[Pair] = []
    for file in sorted(folder.rglob("camera.json")):
        camera, scale = Camera.read(file)
        colors = [next(iter(sorted(file.parent.glob(f"color{end}.*"))), None) for end in (0, 1)]
        if None in colors:
            continue
        prev, curr = (
            RgbdFrame.read(color, file.parent / f"depth{end}.png", camera=camera, depth_scale=scale or 1000)  # type: ignore[arg-type]
            for end, color in enumerate(colors)
        )
        pairs.append(("-".join(file.parent.relative_to(folder).parts), prev, curr))
    return pairs


def numbers(motion: SceneMotion) -> dict[str, Any]:
    """What a result says, as arrays."""
    camera = motion.camera_motion
    return {
        "labels": motion.labels,
        "flow": motion.scene_flow,
        "camera": np.zeros((0, 4, 4)) if camera is None else np.asarray(camera)[None],
        "motions": np.array([obj.prev_T_curr for obj in motion.objects]).reshape(-1, 4, 4),
        "scores": np.array([[obj.score, obj.moving] for obj in motion.objects], float).reshape(-1, 2),
    }


def differences(first: dict[str, Any], second: dict[str, Any]) -> tuple[float, float, float]:
    """Pixels whose label differs, and the largest differences of motions with scores, and of flow."""
    labels = float((first["labels"] != second["labels"]).sum())
    motions = max(largest(first[name], second[name]) for name in ("camera", "motions", "scores"))
    return labels, motions, largest(first["flow"], second["flow"])


def largest(first: Any, second: Any) -> float:
    """Of the differences of two arrays; infinite where their shapes or their gaps differ."""
    if first.shape != second.shape or (np.isnan(first) != np.isnan(second)).any():
        return float("inf")
    return float(np.nanmax(np.abs(first - second), initial=0)) if first.size else 0.0


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"write": Write, "compare": Compare}).run()
