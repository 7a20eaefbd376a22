"""Where torch computes: a device by its name, checked before any work starts."""

from __future__ import annotations

import torch

from objectflow.errors import MethodError


def find_device(name: str = "auto") -> torch.device:
    """`auto` is the first CUDA device, or the CPU where there is none; else any of torch's names, such as `cuda:1`.

    Raises:
        MethodError: no such device in this machine, or a name that torch does not know.
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
        raise MethodError(f"device {name} asked for, but there is {there}: leave it out, or choose cpu")
    try:
        # Devices that this build of torch lacks fail in three ways: by their driver (RuntimeError), at their first use
        # (AssertionError, "Torch not compiled with ..."), or for want of a kernel (NotImplementedError).
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = (str(error).splitlines() or ["it cannot be used"])[0]
        raise MethodError(f"device {name} cannot be used: {reason}") from error
    return device
