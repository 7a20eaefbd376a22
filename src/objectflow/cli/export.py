"""`objectflow export`: a network for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from objectflow.cli.arguments import option

EXAMPLES = """\
  objectflow export --format onnx --weights FILE --out network.onnx
  objectflow export --format onnx --weights FILE --size 480 640 --out network.onnx
"""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write the network of some weights as an ONNX file of one input size, compared with torch by numbers."""

    out: Annotated[Path, option("FILE")]
    """File to write; it appears only if its numbers are torch's."""

    weights: Annotated[str | None, option("FILE|DIR|hf://OWNER/NAME", "the released ones")] = None
    """Weights of a learned method."""

    method: Annotated[str, option("NAME")] = "sceneflownet-c-vl"
    """Whose weights, where they are not named by a file."""

    size: Annotated[tuple[int, int] | None, option("H W", "what the weights were trained at")] = None
    """Height and width of the frames that the file will take."""

    format: Literal["onnx"] = "onnx"
    """The kind of file."""

    def run(self) -> None:
        """Load, export, compare, write."""
        from objectflow.methods.find_weights import find_weights
        from objectflow.methods.network_io import trained_size
        from objectflow.networks.export import OPSET, export_onnx
        from objectflow.networks.weights import load_network

        path = find_weights(self.method, self.weights)
        network, metadata = load_network(path)
        height, width = self.size or trained_size(metadata, path)
        differences = export_onnx(self.out, network, (height, width), metadata)
        worst = max(differences, key=lambda name: differences[name])
        print(
            f"written to {self.out}: {height}x{width}, opset {OPSET}, {self.out.stat().st_size / 2**20:.1f} MiB; "
            f"differs from torch by at most {differences[worst]:.1e} of a map's largest value ({worst})"
        )
