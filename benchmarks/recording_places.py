"""Where things are in each frame of real recordings, told by eye, and what else is true in all of their frames.

Boxes are (left, top, right, bottom) as shares of the image.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from objectflow.alignment.camera_estimate import CameraState
from real_expectations import Box

Places = Mapping[str, Mapping[int, Box]]
"""Where each thing is, by its name and the number of the frame."""

BIN: Places = {
    "ball": {
        12: (0.41, 0.24, 0.54, 0.46), 13: (0.36, 0.27, 0.49, 0.48), 14: (0.34, 0.29, 0.47, 0.51),
        15: (0.31, 0.30, 0.44, 0.53), 21: (0.19, 0.37, 0.34, 0.63), 22: (0.18, 0.39, 0.33, 0.66),
    },
    "carrot": {
        12: (0.03, 0.10, 0.30, 0.43), 13: (0.02, 0.12, 0.29, 0.44), 14: (0.00, 0.13, 0.29, 0.45),
        15: (0.00, 0.16, 0.29, 0.46), 21: (0.07, 0.19, 0.39, 0.47), 22: (0.10, 0.19, 0.42, 0.46),
    },
    "doll": {
        12: (0.29, 0.55, 0.46, 0.83), 13: (0.28, 0.58, 0.46, 0.84), 14: (0.28, 0.59, 0.45, 0.84),
        15: (0.28, 0.60, 0.46, 0.85), 21: (0.37, 0.64, 0.55, 0.89), 22: (0.40, 0.65, 0.57, 0.91),
    },
    "hand": dict.fromkeys(range(12, 16), (0.80, 0.00, 1.00, 0.50)),
}  # fmt: skip
FIRST_TABLE: Places = {
    "brown box": {
        4: (0.46, 0.42, 0.58, 0.70), 5: (0.48, 0.39, 0.60, 0.63), 10: (0.62, 0.37, 0.71, 0.64),
        11: (0.62, 0.37, 0.71, 0.64),
    },
    "yellow box": {
        4: (0.61, 0.52, 0.75, 0.75), 5: (0.61, 0.52, 0.75, 0.75), 10: (0.33, 0.55, 0.47, 0.81),
        11: (0.24, 0.56, 0.39, 0.83),
    },
}  # fmt: skip
SECOND_TABLE: Places = {
    "brown box": {
        3: (0.42, 0.19, 0.58, 0.52), 4: (0.49, 0.17, 0.62, 0.45), 5: (0.43, 0.13, 0.54, 0.39),
        6: (0.43, 0.13, 0.54, 0.39),
    },
    "yellow box": {
        3: (0.65, 0.26, 0.78, 0.47), 4: (0.65, 0.26, 0.78, 0.47), 5: (0.65, 0.26, 0.78, 0.47),
        6: (0.61, 0.29, 0.76, 0.55),
    },
}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """What is true in all frames of a recording.

    Attributes:
        places: things that may move; one moves between two frames in which it is at different places.
        required: those that must be found where they moved.
        allowed: where else something may move.
        cameras: the states of the camera that are right.
        camera: the camera, if users would have to name it.
    """

    places: Places = field(default_factory=dict)
    required: tuple[str, ...] = ()
    allowed: tuple[Box, ...] = ()
    cameras: tuple[CameraState, ...] = ("static",)
    camera: str = "auto"


RECORDINGS: Mapping[str, Recording] = {
    "anygrasp": Recording(BIN, ("ball",), cameras=("static", "moving", "unknown"), camera="moving"),
    "brain": Recording(allowed=((0.15, 0.0, 1.0, 0.76),)),
    "cup": Recording(allowed=((0.0, 0.18, 0.55, 0.97),)),
    "maizena2f_c1": Recording(FIRST_TABLE, ("brown box", "yellow box")),
    "maizena2f_c2": Recording(SECOND_TABLE, ("brown box", "yellow box"), allowed=((0.85, 0.25, 1.0, 0.8),)),
    "tumrpy": Recording(cameras=("moving", "unknown")),
}
"""The recordings by the names of their pair folders: a bin below a moving camera, a hand with toys and an arm with a
mug before static ones, two tables with boxes (the second with somebody on a chair at the right border), and a camera
that is turned fast in a static room."""
