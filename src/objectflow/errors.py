"""The exceptions of the library; each message states what was wrong, where, and what to do."""

from __future__ import annotations

import json

MAX_MESSAGE = 500
"""Maximum length of a message, in characters."""

_HEAD = 330
"""Number of characters that are kept from the start of a longer message."""

_GAP = " ... "
"""Text in place of the characters that are left out."""


def install_command(extra: str) -> str:
    """The command that installs an extra the way objectflow itself was installed: from a checkout or by its name."""
    # Imported here, since only a missing library needs them.
    from importlib import metadata
    from urllib.parse import unquote, urlsplit

    source = "objectflow"
    try:
        record = metadata.distribution("objectflow").read_text("direct_url.json")
        place = json.loads(record or "{}").get("url", "")
    except (metadata.PackageNotFoundError, ValueError, AttributeError):
        place = ""
    if place.startswith("file://"):
        source = unquote(urlsplit(place).path)
    return f'pip install "{source}[{extra}]"'


class ObjectflowError(Exception):
    """Base class of all errors of objectflow. The CLI prints the message as one line and exits with code 2.

    Args:
        message: reduced to one printable line by `one_line`.
    """

    exit_code = 2

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


def one_line(text: str) -> str:
    """Reduce a text to one printable line of at most `MAX_MESSAGE` characters.

    Runs of white space become one space and other unprintable characters their escape sequences. The middle of a
    longer text is left out, because a message ends with what to do.
    """
    # A quoted value may have megabytes; the bounds below exceed what is kept of it.
    if len(text) > 4 * MAX_MESSAGE:
        text = text[: 2 * MAX_MESSAGE] + _GAP + text[-2 * MAX_MESSAGE :]
    line = " ".join(text.split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    if len(line) > MAX_MESSAGE:
        line = line[:_HEAD].rstrip() + _GAP + line[_HEAD + len(_GAP) - MAX_MESSAGE :].lstrip()
    return line


class CameraError(ObjectflowError):
    """Intrinsics that are malformed or do not fit the image."""


class FrameError(ObjectflowError):
    """An RGB-D frame, or a pair of frames, with invalid or implausible content."""


class ReaderError(ObjectflowError):
    """A file, folder or sequence that cannot be read as RGB-D frames."""


class GeometryError(ObjectflowError):
    """A geometric problem without a unique solution, such as a fit to points on a line."""


class ResultError(ObjectflowError):
    """A folder that is no result folder, or one that must not be overwritten."""


class MethodError(ObjectflowError):
    """An unknown method, or an option that a method does not have."""


class SettingsError(MethodError):
    """A setting that does not exist, has another type, or lies out of bounds."""


class DatasetError(ObjectflowError):
    """A data set, shard, manifest or mesh folder that cannot be used."""


class CheckError(ObjectflowError):
    """A source in which `objectflow check --strict` finds something suspicious."""

    exit_code = 1


class TrainingError(ObjectflowError):
    """A training run that cannot start or continue with the given options, or whose losses are no longer finite."""


class MissingExtraError(ObjectflowError):
    """A library of an optional extra is not installed; the message ends with the command that installs it.

    Args:
        need: what is missing and for what, such as "bags need rosbags".
        extra: the name of the extra.
        otherwise: what helps instead.
    """

    def __init__(self, need: str, extra: str = "", *, otherwise: str = "") -> None:
        command = f": {install_command(extra)}" if extra else ""
        super().__init__(f"{need}{command}{otherwise}")


class ViewerError(ObjectflowError):
    """A viewer that cannot be opened: no display or no free port."""


class StorageError(ObjectflowError):
    """A failed read or write: no space, no permission, or a read-only file system."""

    exit_code = 1
