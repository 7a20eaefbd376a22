"""The exceptions of the library; each message states what was wrong, where, and what to do."""


class ObjectflowError(Exception):
    """Base class of all errors of objectflow. The CLI prints the message as one line and exits with code 2."""

    exit_code = 2


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


class TrainingError(ObjectflowError):
    """A training run that cannot start or continue with the given options, or whose losses are no longer finite."""


class MissingExtraError(ObjectflowError):
    """A library of an optional extra is not installed; the message names the extra."""


class ViewerError(ObjectflowError):
    """A viewer that cannot be opened: no display or no free port."""


class StorageError(ObjectflowError):
    """A failed read or write: no space, no permission, or a read-only file system."""

    exit_code = 1
