"""Weights on disk: safetensors whose header describes the network and the origin of the weights. No pickle."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, overload

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from objectflow.errors import MethodError
from objectflow.networks.kinds import KINDS, Network, Settings, kind_of, make_network
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.sceneflownet.network import SceneFlowNet
from objectflow.networks.sceneflownet.settings import NetworkSettings
from objectflow.storage import files

_KEY = "objectflow"
"""The only entry of the header, as JSON: safetensors stores several entries in no fixed order, and equal weights must
give equal bytes."""
_VERSION = 1
_FIRST_KIND = "sceneflownet"
"""The kind of weights whose header has no "kind"."""


def save_weights(path: str | Path, network: Network, metadata: Mapping[str, Any], *, half: bool = False) -> None:
    """Write a network atomically.

    Args:
        path: of the file; an existing one is replaced.
        network: without wrappers such as `torch.compile`'s or DDP's. Its settings are stored in the header.
        metadata: anything that JSON can represent. Estimators read `variant` (the method's name), `size` ([H, W] of
            training) and `grouping` (fields of `GroupingSettings`); `recipe`, `data` (the data set's hash) and
            `metrics` are for documentation.
        half: store matrices and filters as float16, for shipping; vectors, such as running variances, keep their type.

    Raises:
        MethodError: a weight beyond float16's range, or metadata that JSON cannot represent.
        StorageError: the file cannot be written.
    """
    path = Path(path)
    tensors: dict[str, Tensor] = {}
    for name, value in network.state_dict().items():
        tensor = value.detach().to("cpu", memory_format=torch.contiguous_format).contiguous()
        if half and tensor.is_floating_point() and tensor.ndim > 1:
            tensor = tensor.half()
            if not bool(tensor.isfinite().all()):
                raise MethodError(f"{path}: {name} does not fit into float16: save these weights as they are")
        tensors[name] = tensor
    try:
        values = {"version": _VERSION, "network": network.settings.to_dict(), "metadata": dict(metadata)}
        kind = kind_of(network.settings)
        if kind != _FIRST_KIND:
            values["kind"] = kind
        header = json.dumps(values, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{path}: metadata of weights must be plain JSON: {error}") from error
    files.write_bytes(path, safetensors.torch.save(tensors, {_KEY: header}))


def load_weights(
    path: str | Path, device: torch.device | str = "cpu", *, settings: NetworkSettings | None = None
) -> tuple[SceneFlowNet, dict[str, Any]]:
    """`load_network` for a `SceneFlowNet`.

    Raises:
        MethodError: as `load_network`; or weights of another kind of network.
    """
    network, metadata = load_network(path, device, settings=settings)
    if not isinstance(network, SceneFlowNet):
        kind = kind_of(network.settings)
        raise MethodError(f"{path}: weights of {kind}, not of a scene flow network: load them by their own name")
    return network, metadata


@overload
def load_network(
    path: str | Path, device: torch.device | str = "cpu", *, settings: NetworkSettings
) -> tuple[SceneFlowNet, dict[str, Any]]: ...


@overload
def load_network(
    path: str | Path, device: torch.device | str = "cpu", *, settings: RigidMatchSettings
) -> tuple[RigidMatch, dict[str, Any]]: ...


@overload
def load_network(
    path: str | Path, device: torch.device | str = "cpu", *, settings: Settings | None = None
) -> tuple[Network, dict[str, Any]]: ...


def load_network(
    path: str | Path, device: torch.device | str = "cpu", *, settings: Settings | None = None
) -> tuple[Network, dict[str, Any]]:
    """Build the network that a file of `save_weights` describes, and load every tensor strictly.

    Args:
        path: of the file.
        device: of the network.
        settings: the required settings of the network, if any; their FREE fields override those of the file.

    Returns:
        The network in float32 and evaluation mode, and the metadata.

    Raises:
        MethodError: no such file; a truncated, pickled or foreign one; another configuration (the message names the
            field), or tensors that do not fit the configuration.
    """
    path = Path(path)
    found, metadata = read_header(path)
    if settings is not None:
        check_network_settings(found, settings, where=str(path))
        found = settings
    try:
        tensors = safetensors.torch.load_file(path)
    except Exception as error:
        raise _unreadable(path, error) from error
    # Without memory first: a header may describe a network that is larger than this machine.
    with torch.device("meta"):
        wanted = make_network(found).state_dict()
    for name in sorted({*wanted, *tensors}):
        if name not in tensors:
            raise MethodError(f"{path}: damaged: {name} is missing")
        if name not in wanted:
            raise MethodError(f"{path}: damaged: {name} has no place in the network that its header describes")
        if tensors[name].shape != wanted[name].shape:
            sizes = f"{tuple(tensors[name].shape)}, its header declares {tuple(wanted[name].shape)}"
            raise MethodError(f"{path}: damaged: {name} is {sizes}")
        if not bool(tensors[name].isfinite().all()):
            raise MethodError(f"{path}: {name} holds numbers that are not finite: training went wrong")
    with torch.random.fork_rng(devices=[]):  # initial weights are random: keep the caller's generator state
        network = make_network(found)
    network.load_state_dict({name: value.to(wanted[name].dtype) for name, value in tensors.items()}, strict=True)
    return network.to(device).eval(), metadata


def read_header(path: str | Path) -> tuple[Settings, dict[str, Any]]:
    """The settings of the network and the metadata of a file of `save_weights`, without its tensors.

    Raises:
        MethodError: as `load_network`.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise _unreadable(path, FileNotFoundError())  # opening a pipe would wait for its writer
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            entries = file.metadata() or {}
    except Exception as error:
        raise _unreadable(path, error) from error
    if _KEY not in entries:
        raise MethodError(f"{path}: no weights of an objectflow network: its header does not describe one")
    try:
        header = json.loads(entries[_KEY])
        if header["version"] != _VERSION:
            raise MethodError(f"{path}: weights of format {header['version']}, this objectflow reads {_VERSION}")
        network, metadata = header["network"], header["metadata"]
        kind = header.get("kind", _FIRST_KIND)
        if not isinstance(network, dict) or not isinstance(metadata, dict) or not isinstance(kind, str):
            raise ValueError("not an object")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise MethodError(f"{path}: damaged: its header cannot be read") from error
    if kind not in KINDS:
        raise MethodError(f"{path}: weights of a network {kind!r}, which this version of objectflow does not have")
    try:
        return KINDS[kind].settings.from_dict(network), metadata
    except MethodError as error:
        raise MethodError(f"{path}: {error}") from error


def check_network_settings(found: Settings, wanted: Settings, *, where: str) -> None:
    """Check that weights have the required configuration.

    Args:
        found: settings of the weights.
        wanted: the required ones.
        where: start of the error message.

    Raises:
        MethodError: a field that tensors depend on differs; the message names the first one and both values.
    """
    if type(found) is not type(wanted):
        raise MethodError(f"{where}: weights of a {kind_of(found)}, but a {kind_of(wanted)} is required")
    for field in dataclasses.fields(wanted):
        has, needs = getattr(found, field.name), getattr(wanted, field.name)
        if has != needs and field.name not in wanted.FREE:
            raise MethodError(
                f"{where}: weights of another configuration: {field.name} is {has}, but {needs} is required"
            )


def _unreadable(path: Path, error: Exception) -> MethodError:
    if not os.path.exists(path):  # unlike the method of Path, false of a name that is too long or holds a NUL
        return MethodError(f"{path}: no such file")
    if not path.is_file() and not path.is_dir():
        return MethodError(f"{path}: not a regular file")
    if path.is_dir():
        return MethodError(f"{path}: a folder, not a file of weights")
    if isinstance(error, OSError) and error.strerror:
        return MethodError(f"{path}: cannot be read: {error.strerror}")
    with path.open("rb") as file:
        start = file.read(2)
    if start == b"PK" or start[:1] == b"\x80":
        return MethodError(f"{path}: a pickled file, which may run any code: only safetensors are read")
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return MethodError(f"{path}: not a safetensors file, or a truncated one: {reason}")
