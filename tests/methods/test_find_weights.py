"""Where weights are searched: the package, a file, a folder, the hub; and the messages where there are none."""

from __future__ import annotations

import io
import socket
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import objectflow
from helpers.small_networks import save
from objectflow.errors import MethodError, MissingExtraError
from objectflow.methods import find_weights

NAME = "sceneflownet-c-vl"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


@pytest.mark.parametrize("name", [f"{NAME}.safetensors", "weights.safetensors"])
def test_a_folder_is_searched(tmp_path: Path, name: str) -> None:
    path = save(tmp_path / name)
    assert find_weights.find_weights(NAME, tmp_path) == path
    objectflow.load(NAME, weights=tmp_path)


def test_packaged_weights_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(find_weights.HUB_VARIABLE, "nobody/nothing")
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: tmp_path)
    path = save(tmp_path / f"{NAME}.safetensors")
    assert find_weights.find_weights(NAME) == path
    assert find_weights.packaged_weights() == [path]
    objectflow.load(NAME)


def test_a_folder_can_be_named_by_an_environment_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: tmp_path / "package")
    monkeypatch.setenv(find_weights.FOLDER_VARIABLE, str(tmp_path))
    path = save(tmp_path / f"{NAME}.safetensors")
    assert find_weights.find_weights(NAME) == path
    monkeypatch.delenv(find_weights.HUB_VARIABLE, raising=False)
    with pytest.raises(MethodError, match="no weights for rigidmatch"):
        find_weights.find_weights("rigidmatch")
    (tmp_path / "package").mkdir()
    packaged = save(tmp_path / "package" / f"{NAME}.safetensors")
    assert find_weights.find_weights(NAME) == packaged


def test_the_message_without_weights_says_how_to_get_some(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(find_weights.HUB_VARIABLE, raising=False)
    monkeypatch.delenv(find_weights.FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: tmp_path)
    with pytest.raises(MethodError, match=r"no weights for sceneflownet-s .*objectflow train.*hf://OWNER/NAME"):
        objectflow.load("sceneflownet-s")


def test_the_message_of_a_folder_without_weights_names_the_files(tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=f"looked for {NAME}.safetensors, weights.safetensors"):
        objectflow.load(NAME, weights=tmp_path)


# --- the hub ---


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], list[Any]]:
    huggingface_hub = pytest.importorskip("huggingface_hub")

    def answer(result: Any) -> list[Any]:
        asked: list[Any] = []

        def download(*arguments: Any, **options: Any) -> str:
            asked.append((arguments, options))
            if isinstance(result, Exception):
                raise result
            return str(result)

        monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
        # The endpoint answers.
        monkeypatch.setattr(urllib.request, "urlopen", lambda *_, **__: io.BytesIO())
        return asked

    return answer


def test_the_methods_file_is_downloaded_from_the_hub(weights: Path, hub: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = hub(weights)
    objectflow.load(NAME, weights="hf://some/one@v2")
    monkeypatch.setenv(find_weights.HUB_VARIABLE, "some/other")
    monkeypatch.setattr(find_weights, "packaged_folder", lambda: weights.parent / "none")
    assert find_weights.find_weights(NAME) == weights
    file = f"{NAME}.safetensors"
    assert asked == [
        (("some/one", file), {"revision": "v2", "local_files_only": False}),
        (("some/other", file), {"revision": None, "local_files_only": False}),
    ]


def test_a_hub_without_the_file_gives_one_line(hub: Any) -> None:
    from huggingface_hub.errors import EntryNotFoundError

    hub(EntryNotFoundError("There is no such file.\nRequest ID: 7"))
    with pytest.raises(MethodError, match=r"hf://a/b: cannot get \S+ There is no such file: name a file instead$"):
        objectflow.load(NAME, weights="hf://a/b")


def test_an_unreachable_hub_gives_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    constants = pytest.importorskip("huggingface_hub").constants
    with socket.socket() as taken:  # Bound but not listening: every connection is refused.
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setattr(constants, "ENDPOINT", f"http://127.0.0.1:{taken.getsockname()[1]}")
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
        for address, reason in (("a/b", "no connection to http"), ("no name!", "no connection to http")):
            with pytest.raises(MethodError, match=f"hf://{address}: cannot get .*{reason}.*: name a file instead$"):
                objectflow.load(NAME, weights=f"hf://{address}")
    assert capfd.readouterr().err == ""


def test_the_hub_without_its_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[hub\]"'):
        objectflow.load(NAME, weights="hf://a/b")
