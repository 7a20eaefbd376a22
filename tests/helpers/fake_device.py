"""A fake second device: its tensors are computed on the CPU but cannot be mixed with CPU tensors.

On machines without a GPU this finds code that leaves a tensor on the CPU, which raises here as it does with CUDA.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
import torch.distributed.tensor  # torch imports it on first use, and its annotations need the real torch.Generator
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

FAKE_DEVICE = torch.device("meta")
"""A device type that every build of torch supports; the fake tensors wrap CPU tensors instead of being empty."""
_CPU = torch.device("cpu")
_INDEXING = ("aten.index.", "aten.index_put", "aten._index_put_impl", "aten._unsafe_index")
_COPYING = ("aten.copy_.", "aten._to_copy.")


class FakeTensor(torch.Tensor):
    """A tensor on the fake device; `cpu()` returns the values, `numpy()` raises."""

    inner: torch.Tensor
    __torch_function__: ClassVar[Any] = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> FakeTensor:
        out: FakeTensor = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=FAKE_DEVICE,
        )  # fmt: skip
        out.inner = inner
        return out

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    def __repr__(self, **kwargs: Any) -> str:
        return f"on the fake device: {self.inner!r}"

    def tolist(self) -> Any:
        return self.inner.tolist()


class FakeGenerator(torch.Generator):
    """A random generator of the fake device, with the same numbers as on the CPU."""

    device = property(lambda self: FAKE_DEVICE)  # type: ignore[assignment]


@contextlib.contextmanager
def fake_device() -> Iterator[torch.device]:
    """Make `FAKE_DEVICE` usable like any device; mixed precision computes in float32 on it."""
    generator, autocast, enabled = torch.Generator, torch.autocast, torch.is_autocast_enabled

    class Autocast(autocast):
        def __init__(self, device_type: str, *args: Any, **kwargs: Any) -> None:
            super().__init__(_supported(device_type), *args, **kwargs)

    torch.Generator = lambda device="cpu": FakeGenerator() if _is_fake(device) else generator(device)  # type: ignore
    torch.autocast = Autocast  # type: ignore[misc]
    torch.is_autocast_enabled = lambda device_type="cpu": enabled(_supported(device_type))
    try:
        with _FunctionMode(), _DispatchMode():
            yield FAKE_DEVICE
    finally:
        torch.Generator, torch.autocast, torch.is_autocast_enabled = generator, autocast, enabled  # type: ignore[misc]


class _DispatchMode(TorchDispatchMode):
    """Handles operations that name the device but have no tensor argument on it: `torch.zeros(3, device=...)`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _FunctionMode(TorchFunctionMode):
    """Handles operations before the dispatch: tensors made from Python numbers, and the devices of generators."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        named = "device" in kwargs and kwargs["device"] is not None
        fake = _is_fake(kwargs["device"]) if named else any(isinstance(value, FakeTensor) for value in args)
        generator = kwargs.get("generator")
        if generator is not None and isinstance(generator, FakeGenerator) != fake:
            raise RuntimeError(f"{func.__name__}: the generator is another device's")
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            args = (args[0], _index(args[1]), *args[2:])
        if func in (torch.tensor, torch.as_tensor) and named and fake:
            del kwargs["device"]
            return func(*args, **kwargs).to(FAKE_DEVICE)
        if func is torch.Tensor.new_tensor and fake and not named:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(FAKE_DEVICE)
        return func(*args, **kwargs)


def _run(func: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
    """Run an operation on the CPU and wrap the results that belong to the fake device."""
    name = str(func)
    # In inference mode, composite operations such as `to` arrive with the device as a positional argument.
    names = [argument.name for argument in func._schema.arguments[: len(args)]]
    if "device" in names:
        at = names.index("device")
        args, kwargs = args[:at], {**dict(zip(names[at:], args[at:], strict=True)), **kwargs}
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    fake = [isinstance(tensor, FakeTensor) for tensor in tensors]
    _refuse_mixture(name, tensors, fake)
    device = kwargs.get("device")
    result_is_fake = _is_fake(device) if device is not None else any(fake[:1] if name.startswith(_COPYING) else fake)
    kwargs = {key: value for key, value in kwargs.items() if key != "pin_memory"}
    if device is not None:
        kwargs["device"] = _CPU
    out = func(*tree_map(_inner, args), **tree_map(_inner, kwargs))
    if func._schema.is_mutable:
        return args[0]
    known = {
        id(_inner(tensor)): tensor for tensor, is_fake in zip(tensors, fake, strict=True) if is_fake == result_is_fake
    }

    def wrap(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        return known.get(id(value), FakeTensor(value) if result_is_fake else value)

    return tree_map(wrap, out)


def _refuse_mixture(name: str, tensors: list[torch.Tensor], fake: list[bool]) -> None:
    """Raise as CUDA would, which accepts only scalars and indices from the CPU, and copies between the devices."""
    if not any(fake) or name.startswith(_COPYING):
        return
    if name.startswith(_INDEXING):
        mixed = not fake[0]
    else:
        mixed = any(tensor.ndim > 0 and not is_fake for tensor, is_fake in zip(tensors, fake, strict=True))
    if mixed:
        sizes = ", ".join(
            f"{tuple(tensor.shape)} on the {'fake device' if is_fake else 'CPU'}"
            for tensor, is_fake in zip(tensors, fake, strict=True)
        )
        raise RuntimeError(f"{name}: tensors of two devices: {sizes}")


def _index(index: Any) -> Any:
    """Convert lists among indices to CPU tensors."""
    if isinstance(index, tuple):
        return tuple(_index(part) for part in index)
    return torch.tensor(index) if isinstance(index, list) else index


def _inner(value: Any) -> Any:
    return value.inner if isinstance(value, FakeTensor) else value


def _is_fake(device: Any) -> bool:
    return device is not None and torch.device(device).type == FAKE_DEVICE.type


def _supported(device_type: str) -> str:
    return _CPU.type if device_type == FAKE_DEVICE.type else device_type
