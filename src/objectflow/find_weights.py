"""Where a method's weights are: in the package, in a file or folder that the user names, or on the hub."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from objectflow.errors import MethodError, MissingExtraError

HUB = "hf://"
"""`hf://OWNER/NAME` or `hf://OWNER/NAME@REVISION` names a repository on the hub that holds `<method>.safetensors`."""
HUB_VARIABLE = "OBJECTFLOW_HUB"
"""An environment variable: the repository, OWNER/NAME, that is asked where the package has no weights of a method."""
TRAINED = ("weights.safetensors", "best/weights.safetensors", "latest/weights.safetensors")
"""What training writes into its output folder."""


def find_weights(method: str, given: str | Path | None = None) -> Path:
    """The file of a method's weights.

    Args:
        method: its name.
        given: a file; a folder with `<method>.safetensors` or one that training wrote; or `hf://OWNER/NAME`. None: the
            packaged file, else the hub's repository that `OBJECTFLOW_HUB` names.

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
    if repository := os.environ.get(HUB_VARIABLE):
        return _from_hub(repository, method)
    raise MethodError(
        f"no weights for {method} in this installation: train some (objectflow train) and name their file or folder, "
        f"or a hub repository {HUB}OWNER/NAME (--weights, or weights= in Python)"
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
    names = (f"{method}.safetensors", *TRAINED)
    for name in names:
        if (path / name).is_file():
            return path / name
    raise MethodError(f"{path}: no weights in this folder: looked for {', '.join(names)}")


def _from_hub(repository: str, method: str) -> Path:
    """Download into the hub library's own cache, or find it there."""
    try:
        import huggingface_hub
        from huggingface_hub.errors import HfHubHTTPError, HFValidationError
    except ImportError as error:
        raise MissingExtraError(
            f'weights from {HUB}{repository} need huggingface_hub: pip install "objectflow[hub]", or name a file'
        ) from error
    name, _, revision = repository.partition("@")
    try:
        return Path(huggingface_hub.hf_hub_download(name, f"{method}.safetensors", revision=revision or None))
    # Without a network its HTTP library's own errors come through; they are OSErrors or not, by version.
    except (HfHubHTTPError, HFValidationError, OSError, ValueError, RuntimeError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise MethodError(f"{HUB}{repository}: cannot get {method}.safetensors: {reason}: or name a file") from error
