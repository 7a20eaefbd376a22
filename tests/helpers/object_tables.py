"""Object tables of batches, made from rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from objectflow.dataset.schema import PairObject
from objectflow.dataset.targets import ObjectTable


def object_table(rows: Sequence[Sequence[PairObject]]) -> ObjectTable:
    """Pad the object lists of the rows of a batch to one length, at least 1."""
    count = max([1, *(len(objects) for objects in rows)])
    label = torch.zeros(len(rows), count, dtype=torch.int64)
    values = torch.zeros(len(rows), count, 3, 3)
    in_both = torch.zeros(len(rows), count, dtype=torch.bool)
    for b, objects in enumerate(rows):
        for k, entry in enumerate(objects):
            label[b, k] = entry.label
            in_both[b, k] = entry.in_both
            for position, vector in enumerate((entry.center, entry.translation, entry.rotation_vector)):
                values[b, k, position] = torch.as_tensor(vector, dtype=torch.float32)
    return ObjectTable(label, values[:, :, 0], values[:, :, 1], values[:, :, 2], in_both)
