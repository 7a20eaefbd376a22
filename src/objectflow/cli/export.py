"""`objectflow export`: a network as a file for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from objectflow.cli.arguments import option
from objectflow.errors import MethodError
from objectflow.methods.registry import DEFAULT_METHOD, METHODS, has_network
from objectflow.storage.temporaries import sweep

EXAMPLES = """\
  objectflow export --out network.onnx
  objectflow export --weights FILE --out network.onnx
  objectflow export --weights FILE --size 480 640 --out network.onnx
"""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a network as an ONNX file with a fixed input size, verified against torch."""

    out: Annotated[Path, option("FILE")]
    """File to write; it is only written if its results agree with torch's."""

    weights: Annotated[str | None, option("FILE|DIR|hf://OWNER/NAME", "the released ones")] = None
    """Weights of a learned method."""

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """Method whose network is exported; a file given by --weights determines it."""

    size: Annotated[tuple[int, int] | None, option("H W", "the size of training")] = None
    """Height and width of the frames that the exported network takes."""

    format: Literal["onnx"] = "onnx"
    """File format."""

    def run(self) -> None:
        """Load the weights, export the network, verify it, and write the file.

        Raises:
            MethodError: an unknown method, or one without a network.
        """
        from objectflow.methods.find_weights import find_weights
        from objectflow.methods.network_io import trained_size
        from objectflow.networks.export import OPSET, export_onnx
        from objectflow.networks.weights import load_network

        if not has_network(self.method):
            choices = ", ".join(name for name in METHODS if has_network(name))
            raise MethodError(f"the method {self.method} has no network to export: choose one of {choices}")
        sweep(self.out.parent)
        path = find_weights(self.method, self.weights)
        network, metadata = load_network(path)
        height, width = self.size or trained_size(metadata, path)
        differences = export_onnx(self.out, network, (height, width), metadata)
        worst = max(differences, key=lambda name: differences[name])
        print(
            f"written to {self.out}: {height}x{width}, opset {OPSET}, {self.out.stat().st_size / 2**20:.1f} MiB; "
            f"differs from torch by at most {differences[worst]:.1e} of a map's largest value ({worst})"
        )
