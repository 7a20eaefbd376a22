"""Weights on disk: exact round trips, and a one-line error for every kind of wrong file."""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from helpers.small_networks import TINY, TINY_RIGID
from objectflow.errors import MethodError, StorageError
from objectflow.methods.find_weights import packaged_folder
from objectflow.networks import SceneFlowNet
from objectflow.networks.rigidmatch import RigidMatch
from objectflow.networks.weights import load_network, load_weights, read_header, save_weights

PACKAGED, WEIGHTS = packaged_folder(), Path(__file__).parents[2] / "weights"
METADATA = {"variant": "sceneflownet-c", "size": [48, 64], "metrics": {"epe": 0.0125, "f": None}, "seconds": 3.5}


def network(seed: int = 0, **changes: Any) -> SceneFlowNet:
    settings = dataclasses.replace(TINY, **changes)
    return SceneFlowNet(settings, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "weights.safetensors"
    save_weights(path, network(), METADATA)
    return path


def test_weights_come_back_bit_for_bit_with_their_metadata(saved: Path) -> None:
    before = torch.get_rng_state()
    found, metadata = load_weights(saved)
    assert torch.equal(torch.get_rng_state(), before)
    assert metadata == METADATA
    assert not found.training
    assert found.settings == TINY
    expected = network().state_dict()
    assert list(found.state_dict()) == list(expected)
    assert all(torch.equal(value, expected[name]) for name, value in found.state_dict().items())
    assert read_header(saved) == (TINY, METADATA)


def test_equal_weights_are_equal_bytes(saved: Path) -> None:
    other = saved.with_name("other.safetensors")
    save_weights(other, network().to(memory_format=torch.channels_last), dict(reversed(METADATA.items())))  # type: ignore[call-overload]
    assert other.read_bytes() == saved.read_bytes()


def test_half_precision_is_half_the_size_and_loads_as_float32(saved: Path) -> None:
    original = network()
    original.color_encoder.trunk.bn1.running_var.fill_(1e6)  # type: ignore[union-attr]  # beyond float16
    small = saved.with_name("half.safetensors")
    save_weights(small, original, METADATA, half=True)
    assert small.stat().st_size < 0.6 * saved.stat().st_size
    state = load_weights(small)[0].state_dict()
    for name, value in original.state_dict().items():
        assert state[name].dtype == value.dtype
        torch.testing.assert_close(state[name], value, rtol=2**-11, atol=2**-25)


def test_a_weight_beyond_float16_is_named(tmp_path: Path) -> None:
    large = network()
    torch.nn.init.constant_(large.heads.maps["mask"].weight, 1e5)  # type: ignore[arg-type]
    with pytest.raises(MethodError, match=r"heads\.maps\.mask\.weight does not fit into float16"):
        save_weights(tmp_path / "w.safetensors", large, {}, half=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"correlation": False}, "correlation is True, but False is required"),
        ({"reach": 2}, "reach is 1, but 2 is required"),
        ({"trunk_norm": "frozen"}, "trunk_norm is batch, but frozen is required"),
        ({"fine": ((8, 8), (8, 8), (8,))}, "fine is .* is required"),
    ],
)
def test_another_configuration_names_the_field(saved: Path, changes: dict[str, Any], message: str) -> None:
    load_weights(saved, settings=TINY)
    with pytest.raises(MethodError, match=message):
        load_weights(saved, settings=dataclasses.replace(TINY, **changes))


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def cut_header(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:20])


def pickled(path: Path) -> None:
    torch.save(network().state_dict(), path)


def old_pickle(path: Path) -> None:
    torch.save(network().state_dict(), path, _use_new_zipfile_serialization=False)


def foreign(path: Path) -> None:
    safetensors.torch.save_file({"a": torch.zeros(3)}, path)


def rewrite_header(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def rewrite(path: Path) -> None:
        data = path.read_bytes()
        length = struct.unpack("<Q", data[:8])[0]
        outer = json.loads(data[8 : 8 + length])
        inner = json.loads(outer["__metadata__"]["objectflow"])
        change(inner)
        outer["__metadata__"]["objectflow"] = json.dumps(inner)
        header = json.dumps(outer).encode()
        path.write_bytes(struct.pack("<Q", len(header)) + header + data[8 + length :])

    return rewrite


def with_nan(path: Path) -> None:
    broken = network()
    torch.nn.init.constant_(broken.heads.maps["mask"].bias, torch.nan)  # type: ignore[arg-type]
    save_weights(path, broken, {})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (truncate, "not a safetensors file, or a truncated one"),
        (cut_header, "not a safetensors file, or a truncated one"),
        (lambda path: path.write_bytes(b""), "not a safetensors file, or a truncated one"),
        (lambda path: path.write_text("hello, this is no file of weights"), "not a safetensors file"),
        (pickled, "a pickled file, which may run any code"),
        (old_pickle, "a pickled file, which may run any code"),
        (foreign, "its header does not describe one"),
        (rewrite_header(lambda h: h.update(version=9)), "weights of format 9, this objectflow reads 1"),
        (rewrite_header(lambda h: h.pop("network")), "damaged: its header cannot be read"),
        (rewrite_header(lambda h: h["network"].update(deep=1)), "unknown network setting 'deep'"),
        (rewrite_header(lambda h: h["network"].update(color_channels=8)), "project.bias is .*, its header declares"),
        (rewrite_header(lambda h: h["network"].update(trunk_blocks=[1, 2])), "layer2.1.bn1.bias is missing"),
        (rewrite_header(lambda h: h["network"].update(correlation=False)), "color_encoder.* has no place"),
        (with_nan, "heads.maps.mask.bias holds numbers that are not finite"),
        (lambda path: path.unlink(), "no such file"),
        (lambda path: (path.unlink(), path.mkdir()), "a folder, not a file of weights"),
    ],
)
def test_a_wrong_file_is_one_clear_line(saved: Path, spoil: Callable[[Path], None], message: str) -> None:
    spoil(saved)
    with pytest.raises(MethodError, match=message) as caught:
        load_weights(saved)
    assert str(caught.value).startswith(f"{saved}: ")
    assert "\n" not in str(caught.value)


def test_nothing_is_left_where_saving_fails(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match="metadata of weights must be plain JSON"):
        save_weights(tmp_path / "w.safetensors", network(), {"recipe": object()})
    with pytest.raises(StorageError):
        save_weights(tmp_path / "none" / "w.safetensors", network(), {})
    assert not list(tmp_path.iterdir())


def test_a_retired_setting_is_accepted_with_its_implemented_value_only(saved: Path) -> None:
    rewrite_header(lambda h: h["network"].update(missing="channel", correlation_mean=False))(saved)
    assert load_weights(saved)[0].settings == TINY
    rewrite_header(lambda h: h["network"].update(missing="masked"))(saved)
    with pytest.raises(MethodError, match="missing is 'masked', which this version no longer implements") as caught:
        load_weights(saved)
    assert str(caught.value).startswith(f"{saved}: ")


@pytest.mark.parametrize("path", [PACKAGED / "rigidmatch.safetensors", WEIGHTS / "sceneflownet-c-vl.safetensors"])
def test_released_weights_are_read(path: Path) -> None:
    if not path.is_file():
        pytest.skip(f"{path} is not here")
    network, metadata = load_network(path)
    assert metadata["variant"] == path.stem
    assert read_header(path)[0] == network.settings


def test_fields_that_no_tensor_depends_on_may_be_overridden(tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    save_weights(path, RigidMatch(TINY_RIGID), {})
    wanted = dataclasses.replace(TINY_RIGID, queries=TINY_RIGID.queries + 5, seed_radius=0.07)
    loaded, _ = load_network(path, settings=wanted)
    assert isinstance(loaded, RigidMatch)
    assert loaded.settings == loaded.decoder.settings == wanted
    other = dataclasses.replace(TINY_RIGID, window_geometry=False)
    with pytest.raises(MethodError, match="another configuration: window_geometry is True, but False is required"):
        load_network(path, settings=other)
