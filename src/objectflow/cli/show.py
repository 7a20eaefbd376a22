"""`objectflow show`: one row of a data set as an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import open_pairs, open_sequences
from objectflow.dataset.show import draw_frames, draw_pair
from objectflow.errors import DatasetError
from objectflow.storage import files
from objectflow.storage.images import encode_png
from objectflow.storage.temporaries import sweep

EXAMPLES = """\
  objectflow show data --key train-000012
  objectflow show data --key test-sequence-000003 --out sequence.png
"""


@dataclass(frozen=True)
class Show:
    """Draw one pair (frames, depth, labels, flow and centres), or all frames of a sequence."""

    data: Annotated[Positional[Path], option("DIR")]
    """Folder of the data set."""

    key: str
    """Key of the pair, or name of the sequence."""

    out: Path | None = None
    """Image to write; KEY.png if not given."""

    def run(self) -> None:
        """Find the row and draw it."""
        manifest = Manifest.read(self.data)
        image, known = None, list[str]()
        for part in manifest.parts.values():
            if part.kind == "pairs":
                pairs = open_pairs(self.data, part.split)
                known += (keys := pairs.keys())
                if self.key in keys:
                    image = draw_pair(pairs[keys.index(self.key)])
            else:
                frames = open_sequences(self.data, part.split)
                sequences = [key.split("/")[0] for key in frames.keys()]  # noqa: SIM118 - not a mapping
                known += dict.fromkeys(sequences)
                if self.key in sequences and image is None:
                    image = draw_frames([frames[i] for i, name in enumerate(sequences) if name == self.key])
        if image is None:
            raise DatasetError(f"{self.data}: no row {self.key!r}; there is {known[0]} to {known[-1]}")
        out = self.out or Path(f"{self.key}.png")
        sweep(out.parent)
        files.write_bytes(out, encode_png(image))
        print(f"written to {out}")
