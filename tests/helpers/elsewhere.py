"""A second device on a machine that has none: its tensors compute on the CPU, but will not mix with the CPU's own.

What is written for a GPU and only ever run without one breaks where a tensor was forgotten on the CPU. Here that
raises, as it does there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

ELSEWHERE = torch.device("meta")
"""Any device that every build of torch knows; its own tensors hold nothing, these hold a tensor of the CPU."""
_HOME = torch.device("cpu")
_INDEXING = ("aten.index.", "aten.index_put", "aten._index_put_impl", "aten._unsafe_index")
_COPYING = ("aten.copy_.", "aten._to_copy.")


class Tensor(torch.Tensor):
    """A tensor of the second device. `cpu()` gives its numbers, `numpy()` refuses."""

    inner: torch.Tensor
    __torch_function__: ClassVar[Any] = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Tensor:
        out: Tensor = torch.Tensor._make_wrapper_subclass(
            cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=ELSEWHERE,
        )  # fmt: skip
        out.inner = inner
        return out

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})

    def __repr__(self, **kwargs: Any) -> str:
        return f"elsewhere: {self.inner!r}"

    def tolist(self) -> Any:
        return self.inner.tolist()


class Generator(torch.Generator):
    """Random numbers for the second device; the same as the CPU's."""

    device = property(lambda self: ELSEWHERE)  # type: ignore[assignment]


@contextlib.contextmanager
def second_device() -> Iterator[torch.device]:
    """While it lasts, `ELSEWHERE` is a device like any other. Mixed precision computes in float32 there."""
    generator, autocast, enabled = torch.Generator, torch.autocast, torch.is_autocast_enabled

    class Autocast(autocast):
        def __init__(self, device_type: str, *args: Any, **kwargs: Any) -> None:
            super().__init__(_supported(device_type), *args, **kwargs)

    torch.Generator = lambda device="cpu": Generator() if _is_elsewhere(device) else generator(device)  # type: ignore
    torch.autocast = Autocast  # type: ignore[misc]
    torch.is_autocast_enabled = lambda device_type="cpu": enabled(_supported(device_type))
    try:
        with _Making(), _Dispatch():
            yield ELSEWHERE
    finally:
        torch.Generator, torch.autocast, torch.is_autocast_enabled = generator, autocast, enabled  # type: ignore[misc]


class _Dispatch(TorchDispatchMode):
    """For operations that only name the device, not one of its tensors: `torch.zeros(3, device=...)`."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Making(TorchFunctionMode):
    """For what torch does before it dispatches: tensors made of Python's numbers, and the devices of generators."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        named = "device" in kwargs and kwargs["device"] is not None
        there = _is_elsewhere(kwargs["device"]) if named else any(isinstance(one, Tensor) for one in args)
        generator = kwargs.get("generator")
        if generator is not None and isinstance(generator, Generator) != there:
            raise RuntimeError(f"{func.__name__}: the generator is another device's")
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            args = (args[0], _index(args[1]), *args[2:])
        if func in (torch.tensor, torch.as_tensor) and named and there:
            del kwargs["device"]
            return func(*args, **kwargs).to(ELSEWHERE)
        if func is torch.Tensor.new_tensor and there and not named:
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(ELSEWHERE)
        return func(*args, **kwargs)


def _run(func: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
    """Compute on the CPU, and say that it was elsewhere where it would have been."""
    name = str(func)
    # In inference mode whole operations arrive, such as `to`, with the device among their positional arguments.
    names = [one.name for one in func._schema.arguments[: len(args)]]
    if "device" in names:
        at = names.index("device")
        args, kwargs = args[:at], {**dict(zip(names[at:], args[at:], strict=True)), **kwargs}
    tensors = [one for one in tree_leaves((args, kwargs)) if isinstance(one, torch.Tensor)]
    there = [isinstance(one, Tensor) for one in tensors]
    _refuse_mixture(name, tensors, there)
    asked = kwargs.get("device")
    stays = _is_elsewhere(asked) if asked is not None else any(there[:1] if name.startswith(_COPYING) else there)
    kwargs = {key: value for key, value in kwargs.items() if key != "pin_memory"}
    if asked is not None:
        kwargs["device"] = _HOME
    out = func(*tree_map(_inner, args), **tree_map(_inner, kwargs))
    if func._schema.is_mutable:
        return args[0]
    known = {id(_inner(one)): one for one, is_there in zip(tensors, there, strict=True) if is_there == stays}

    def carried(one: Any) -> Any:
        if not isinstance(one, torch.Tensor):
            return one
        return known.get(id(one), Tensor(one) if stays else one)

    return tree_map(carried, out)


def _refuse_mixture(name: str, tensors: list[torch.Tensor], there: list[bool]) -> None:
    """Raise where CUDA would: it takes numbers, and indices, of the CPU, and copies between the two."""
    if not any(there) or name.startswith(_COPYING):
        return
    if name.startswith(_INDEXING):
        wrong = not there[0]
    else:
        wrong = any(one.ndim > 0 and not is_there for one, is_there in zip(tensors, there, strict=True))
    if wrong:
        sizes = ", ".join(
            f"{tuple(one.shape)} {'elsewhere' if is_there else 'on the CPU'}"
            for one, is_there in zip(tensors, there, strict=True)
        )
        raise RuntimeError(f"{name}: tensors of two devices: {sizes}")


def _index(index: Any) -> Any:
    """Lists among indices as tensors of the CPU."""
    if isinstance(index, tuple):
        return tuple(_index(one) for one in index)
    return torch.tensor(index) if isinstance(index, list) else index


def _inner(one: Any) -> Any:
    return one.inner if isinstance(one, Tensor) else one


def _is_elsewhere(device: Any) -> bool:
    return device is not None and torch.device(device).type == ELSEWHERE.type


def _supported(device_type: str) -> str:
    return _HOME.type if device_type == ELSEWHERE.type else device_type
