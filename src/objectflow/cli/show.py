"""`objectflow show`: rows of a data set as an image."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import open_pairs, open_sequences
from objectflow.errors import DatasetError
from objectflow.storage import files
from objectflow.storage.images import encode_png
from objectflow.view.data_pictures import draw_frames, draw_pair, draw_rows

EXAMPLES = """\
  objectflow show data
  objectflow show data --key train-000012
  objectflow show data --key test-sequence-000003 --out sequence.png
"""

FIRST = 4
"""Number of pairs that are shown without --key."""


@dataclass(frozen=True)
class Show:
    """Draw one pair (frames, depth, labels, and the flow as in flow.png) or all frames of a sequence.

    Without --key the first pairs of the data set are drawn, one per line, or the first sequence if there are no pairs.
    """

    data: Annotated[Positional[Path], option("DIR")]
    """Folder of the data set."""

    key: Annotated[str | None, option("KEY", "the first rows")] = None
    """Key of the pair, or name of the sequence."""

    out: Annotated[Path | None, option("FILE", "KEY.png, or the name of the data set")] = None
    """Image to write."""

    def run(self) -> None:
        """Find the rows and draw them."""
        manifest = Manifest.read(self.data)
        image, known = None, list[str]()
        parts = sorted((part for part in manifest.parts.values() if part.rows), key=lambda part: part.kind != "pairs")
        for part in parts:
            if image is not None:
                break
            if part.kind == "pairs":
                pairs = open_pairs(self.data, part.split)
                known += (keys := pairs.keys())
                if self.key is None:
                    image = draw_rows([pairs[index] for index in range(min(FIRST, len(keys)))])
                elif self.key in keys:
                    image = draw_pair(pairs[keys.index(self.key)])
            else:
                frames = open_sequences(self.data, part.split)
                sequences = [key.split("/")[0] for key in frames.keys()]  # noqa: SIM118 - not a mapping
                known += dict.fromkeys(sequences)
                chosen = sequences[0] if self.key is None else self.key
                if chosen in sequences:
                    image = draw_frames([frames[i] for i, name in enumerate(sequences) if name == chosen])
        if not known:
            raise DatasetError(f"{self.data}: the data set is empty")
        if image is None:
            near = difflib.get_close_matches(str(self.key), known, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise DatasetError(f"{self.data}: no row {self.key!r}: {hint}rows: {known[0]} to {known[-1]}")
        out = self.out or Path(f"{self.key or self.data.resolve().name}.png")
        files.write_bytes(out, encode_png(image))
        print(f"written to {out}")
