"""Weights of `rigidmatch` from objectflow 0.1 under the tensor names of this version; numbers stay as they are.

python scripts/convert_rigidmatch_weights.py old.safetensors new.safetensors
"""

from __future__ import annotations

import sys
from pathlib import Path

import safetensors.torch
import torch

from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.weights import read_header, save_weights

RENAMED = {
    "place.": "position.",
    "scene.": "dense_head.",
    "matching.hidden.": "matching.dustbin.",
    "refinement.own.": "refinement.project.",
    "decoder.place.": "decoder.position.",
    "decoder.token_place.": "decoder.token_position.",
    "decoder.look.": "decoder.mask_embedding.",
    "decoder.pixel_look.": "decoder.pixel_embedding.",
}
"""Prefixes of tensor names, old and new."""


def new_name(name: str) -> str:
    """The name of a tensor in the present version."""
    for old, new in RENAMED.items():
        if name.startswith(old):
            return new + name.removeprefix(old)
    return name


def main() -> None:
    """Convert the first argument to the second."""
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    source, out = Path(sys.argv[1]), Path(sys.argv[2])
    settings, metadata = read_header(source)
    if not isinstance(settings, RigidMatchSettings):
        raise SystemExit(f"{source}: not weights of rigidmatch")
    tensors = {new_name(name): value for name, value in safetensors.torch.load_file(source).items()}
    half = any(value.dtype == torch.float16 for value in tensors.values())
    network = RigidMatch(settings)
    network.load_state_dict({name: value.to(network.state_dict()[name].dtype) for name, value in tensors.items()})
    save_weights(out, network, metadata, half=half)
    print(f"{out}: {len(tensors)} tensors")


if __name__ == "__main__":
    main()
