"""Where a method's weights are: in a file or folder that the user names, in the package, or on the hub."""

from __future__ import annotations

import os
import urllib.error
import urllib.request
from importlib import resources
from pathlib import Path

from objectflow.errors import MethodError, MissingExtraError

HUB = "hf://"
"""`hf://OWNER/NAME` or `hf://OWNER/NAME@REVISION` names a repository on the hub that holds `<method>.safetensors`."""
FOLDER_VARIABLE = "OBJECTFLOW_WEIGHTS"
"""An environment variable: a folder that is searched where the package has no weights of a method."""
HUB_VARIABLE = "OBJECTFLOW_HUB"
"""An environment variable: the repository, OWNER/NAME, that is asked last."""
_PATIENCE = 10
"""Seconds to wait for the hub's answer."""
TRAINED = "weights.safetensors"
"""What training writes into its output folder, and into each checkpoint."""


def find_weights(method: str, given: str | Path | None = None) -> Path:
    """The file of a method's weights.

    Args:
        method: its name.
        given: a file; a folder with `<method>.safetensors` or one that training wrote; or `hf://OWNER/NAME`. None: the
            packaged file, else the one in the folder that `OBJECTFLOW_WEIGHTS` names, else the hub's repository that
            `OBJECTFLOW_HUB` names.

    Raises:
        MethodError: there are none; the message says how to get some.
        MissingExtraError: the hub is asked without its library.
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
        f"no weights for {method} in this installation: train some (objectflow train) and name their file or folder, "
        f"or a hub repository {HUB}OWNER/NAME (--weights, or weights= in Python); the repository's folder weights has "
        "some of the paper's network"
    )


def packaged_folder() -> Path:
    """Where released weights lie inside the package."""
    return Path(str(resources.files("objectflow"))) / "weights"


def packaged_weights() -> list[Path]:
    """The released weights in this installation, by name."""
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
    """Download into the hub library's own cache, or find it there where there is no connection."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise MissingExtraError(
            f'weights from {HUB}{repository} need huggingface_hub: pip install "objectflow[hub]", or name a file'
        ) from error
    name, _, revision = repository.partition("@")
    # Asked without a connection, the library would try again and again, and tell of each time.
    offline = _unreachable(huggingface_hub.constants.ENDPOINT)
    try:
        path = huggingface_hub.hf_hub_download(
            name, f"{method}.safetensors", revision=revision or None, local_files_only=offline is not None
        )
    # The library raises errors of its own, of its HTTP library and of the disk, with other parents in every version.
    except Exception as error:
        reason = offline or (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        raise MethodError(
            f"{HUB}{repository}: cannot get {method}.safetensors: {reason}: name a file instead"
        ) from error
    return Path(path)


def _unreachable(address: str) -> str | None:
    """Why a server cannot be reached; None where it answers, whatever it says."""
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=_PATIENCE).close()
    except urllib.error.HTTPError:
        return None
    except (OSError, ValueError) as error:
        return f"no connection to {address}: {getattr(error, 'reason', error)}"
    return None
