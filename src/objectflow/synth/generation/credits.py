"""Credits of the meshes in a data set: title, author, licence and source of every model that it shows."""

from __future__ import annotations

import json
from pathlib import Path

from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import read_models
from objectflow.errors import DatasetError
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors

FILE = "credits.json"
"""Name of the file in the mesh folder and in the data set: the path of each mesh within its folder -> its entry."""


def write_credits(out: Path, meshes: Path, manifest: Manifest) -> bool:
    """Copy the credits of the meshes that a data set contains from the mesh folder's file into the set's.

    Args:
        out: folder of the data set.
        meshes: folder of the meshes.
        manifest: of the data set.

    Returns:
        Whether the mesh folder has credits.

    Raises:
        DatasetError: the mesh folder's credits are not a JSON object.
        StorageError: writing failed.
    """
    path = meshes / FILE
    if not path.is_file():
        return False
    with foreign_errors(DatasetError, f"{path} is not a JSON object of meshes and their credits"):
        known = dict(json.loads(path.read_bytes()))
    used: set[str] = set()
    for part in manifest.parts.values():
        for shard in part.shards:
            used |= read_models(out / shard.file)
    chosen = {name: entry for name, entry in sorted(known.items()) if name in used}
    files.write_text(out / FILE, json.dumps(chosen, indent=1, ensure_ascii=False) + "\n")
    return True
