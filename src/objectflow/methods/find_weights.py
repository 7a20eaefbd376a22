"""Locating a method's weights: in a given file or folder, in the package, or on the hub."""

from __future__ import annotations

import os
import urllib.error
import urllib.request
from importlib import resources
from pathlib import Path

from objectflow.errors import MethodError, MissingExtraError

HUB = "hf://"
"""Prefix of hub repositories with `<method>.safetensors`: `hf://OWNER/NAME` or `hf://OWNER/NAME@REVISION`."""
FOLDER_VARIABLE = "OBJECTFLOW_WEIGHTS"
"""Environment variable: a folder that is searched if the package has no weights for a method."""
HUB_VARIABLE = "OBJECTFLOW_HUB"
"""Environment variable: the hub repository, OWNER/NAME, that is searched last."""
_PATIENCE = 10
"""Timeout of a connection to the hub in seconds."""
TRAINED = "weights.safetensors"
"""Name of the weights file that training writes into its output folder and into each checkpoint."""


def find_weights(method: str, given: str | Path | None = None) -> Path:
    """Find the file with a method's weights.

    Args:
        method: the method's name.
        given: a file; a folder with `<method>.safetensors`, or written by training; or `hf://OWNER/NAME`. If None, the
            packaged file, else the file in the folder `OBJECTFLOW_WEIGHTS`, else the file in the hub repository
            `OBJECTFLOW_HUB`.

    Raises:
        MethodError: no weights were found; the message explains how to obtain them.
        MissingExtraError: the hub is needed but its library is not installed.
    """
    if given is not None:
        if str(given).startswith(HUB):
            return _from_hub(str(given)[len(HUB) :], method)
        return _from_disk(Path(given), method)
    file = packaged_folder() / f"{method}.safetensors"
    if file.is_file():
        return file
    if folder := os.environ.get(FOLDER_VARIABLE):
        file = Path(folder) / f"{method}.safetensors"
        if file.is_file():
            return file
    if repository := os.environ.get(HUB_VARIABLE):
        return _from_hub(repository, method)
    raise MethodError(
        f"no weights for {method} in this installation: train the method (objectflow train), then pass the file or "
        f"folder, or a hub repository {HUB}OWNER/NAME (--weights, or weights= in Python); some weights of the "
        "paper's network are in the folder weights of the source repository"
    )


def packaged_folder() -> Path:
    """Folder of the released weights inside the package."""
    return Path(str(resources.files("objectflow"))) / "weights"


def packaged_weights() -> list[Path]:
    """Released weights in this installation, sorted by name."""
    return sorted(packaged_folder().glob("*.safetensors"))


def _from_disk(path: Path, method: str) -> Path:
    if path.is_file():
        return path
    if not path.exists():
        raise MethodError(f"{path}: no such file or folder of weights")
    names = (f"{method}.safetensors", TRAINED)
    for name in names:
        if (path / name).is_file():
            return path / name
    raise MethodError(f"{path}: no weights in this folder: looked for {', '.join(names)}")


def _from_hub(repository: str, method: str) -> Path:
    """Download the weights into the hub library's cache, or use the cached file if the hub cannot be reached."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise MissingExtraError(
            f"weights from {HUB}{repository} need huggingface_hub", "hub", otherwise=", or name a file"
        ) from error
    name, _, revision = repository.partition("@")
    # Without a connection, the library would retry several times and print a message each time.
    offline = _unreachable(huggingface_hub.constants.ENDPOINT)
    try:
        path = huggingface_hub.hf_hub_download(
            name, f"{method}.safetensors", revision=revision or None, local_files_only=offline is not None
        )
    # The library raises its own, HTTP and file system errors, whose base classes differ between versions.
    except Exception as error:
        reason = offline or (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        raise MethodError(
            f"{HUB}{repository}: cannot get {method}.safetensors: {reason}: name a file instead"
        ) from error
    return Path(path)


def _unreachable(address: str) -> str | None:
    """Return why a server cannot be reached, or None if it responds with any HTTP status."""
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PATIENCE).close()
    except urllib.error.HTTPError:
        return None
    except (OSError, ValueError) as error:
        return f"no connection to {address}: {getattr(error, 'reason', error)}"
    return None
