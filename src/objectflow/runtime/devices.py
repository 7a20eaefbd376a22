"""The torch device of a name, checked before any work starts."""

from __future__ import annotations

import torch

from objectflow.errors import MethodError


def find_device(name: str = "auto") -> torch.device:
    """Find a device by its torch name, such as `cuda:1`; `auto` is the first CUDA device, or the CPU without one.

    Raises:
        MethodError: this machine lacks the device, or torch does not know the name.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise MethodError(f"unknown device {name!r}: choose auto, cpu, cuda or cuda:N") from None
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        count = torch.cuda.device_count()
        there = "no CUDA device that this torch can use" if not count else f"only {count} CUDA devices"
        raise MethodError(f"device {name} is not available, since there is {there}: omit it or choose cpu")
    try:
        # A device that this build of torch does not support fails in its driver (RuntimeError), at its first use
        # (AssertionError, "Torch not compiled with ..."), or because a kernel is missing (NotImplementedError).
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = (str(error).splitlines() or ["it cannot be used"])[0]
        raise MethodError(f"device {name} cannot be used: {reason}") from error
    return device
