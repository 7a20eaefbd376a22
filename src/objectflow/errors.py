"""The exceptions that the library raises: each says what was wrong, where, and what to do."""


class ObjectflowError(Exception):
    """Anything that objectflow itself finds wrong. The CLI prints its message as one line and exits with 2."""

    exit_code = 2


class CameraError(ObjectflowError):
    """Intrinsics that are malformed or do not fit the image."""


class FrameError(ObjectflowError):
    """An RGB-D frame, or a pair of frames, that cannot be what it claims to be."""


class ReaderError(ObjectflowError):
    """A file, folder or sequence that cannot be read as RGB-D frames."""


class GeometryError(ObjectflowError):
    """A geometric problem without a unique solution, such as a fit to points on a line."""


class ResultError(ObjectflowError):
    """A result folder that is not one, or one that must not be overwritten."""


class MethodError(ObjectflowError):
    """An unknown method, or an option that a method does not have."""


class DatasetError(ObjectflowError):
    """A data set, shard, manifest or mesh folder that cannot be used."""


class TrainingError(ObjectflowError):
    """A training run that cannot start or continue as asked, or whose losses are no numbers any more."""


class MissingExtraError(ObjectflowError):
    """A library of an optional extra is not installed; the message names the extra."""


class ViewerError(ObjectflowError):
    """A viewer that cannot be opened here: no display, no free port."""


class StorageError(ObjectflowError):
    """The disk refused: no room, no permission, a read-only file system."""

    exit_code = 1
