"""What is true in real pairs, as far as it can be told by eye: where something moves, what must be found, the camera.

A mover is a thing that moved by more than 7 mm against the room. Boxes are (left, top, right, bottom) as shares of the
image. Pairs with a `truth.npz` are judged by their masks instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Expectation:
    """What a correct result of a pair has.

    Attributes:
        required: where each thing that must be found is, by its name.
        allowed: where else something may move, such as an arm that is not rigid.
        anywhere: whether movers may be anywhere: a person fills the image.
        cameras: the states of the camera that are right.
        max_displacement: metres by which no mover may be said to have moved more.
        min_cover: share of a required thing's box that its mask covers.
    """

    required: Mapping[str, Box] = field(default_factory=dict)
    allowed: tuple[Box, ...] = ()
    anywhere: bool = False
    cameras: tuple[Literal["static", "moving", "unknown"], ...] = ("static", "moving", "unknown")
    max_displacement: float = float("inf")
    min_cover: float = 0.2


NOTHING_MOVES = Expectation()
STATIC_ROOM = Expectation(cameras=("static",))
HANDHELD_ROOM = Expectation(cameras=("moving", "unknown"))
_CUP_ARM: Box = (0.0, 0.24, 0.37, 0.68)

EXPECTATIONS: dict[str, Expectation] = {
    # A static stereo camera before an arm with a mug.
    "cup_021_024": Expectation(
        {"arm": (0.0, 0.22, 0.28, 0.64)}, ((0.0, 0.2, 0.3, 0.66), (0.25, 0.5, 0.5, 0.85)), cameras=("static",)
    ),
    "cup_039_048": Expectation({"arm": _CUP_ARM}, ((0.37, 0.5, 0.48, 0.85),), cameras=("static",)),
    "cup_045_048": Expectation({"arm": _CUP_ARM}, cameras=("static",)),
    "cup_057_087": Expectation({"arm": (0.0, 0.27, 0.24, 0.72)}, ((0.2, 0.58, 0.48, 0.94),), cameras=("static",)),
    "cup_069_072": Expectation({"mug": (0.3, 0.58, 0.47, 0.9)}, ((0.0, 0.4, 0.33, 0.84),), cameras=("static",)),
    "cup_093_096": Expectation({"arm": (0.0, 0.2, 0.25, 0.66)}, ((0.2, 0.46, 0.5, 0.88),), cameras=("static",)),
    # A bin below a moving stereo camera.
    "anygrasp_012_013": Expectation(allowed=((0.0, 0.08, 0.30, 0.46), (0.365, 0.26, 0.50, 0.50))),
    "anygrasp_014_015": Expectation({"ball": (0.30, 0.28, 0.45, 0.54), "carrot": (0.0, 0.14, 0.31, 0.46)}),
    "anygrasp_021_022": Expectation({"ball": (0.18, 0.38, 0.35, 0.66)}),
    "morobot_003_004": Expectation({"part": (0.50, 0.33, 0.82, 0.63)}),
    # A hand and a toy before a static time-of-flight camera.
    "brain_045_050": Expectation(allowed=((0.25, 0.1, 0.68, 0.62), (0.72, 0.26, 0.93, 0.43), (0.55, 0.0, 1.0, 0.3))),
    "brain_420_435": Expectation(
        {"toy": (0.4, 0.2, 0.62, 0.7)}, ((0.25, 0.0, 1.0, 0.5), (0.25, 0.45, 0.6, 0.7)), max_displacement=0.3
    ),
    "brain_720_735": Expectation(allowed=((0.3, 0.0, 1.0, 0.5), (0.42, 0.1, 0.68, 0.72)), max_displacement=0.2),
    "brain_900_930": NOTHING_MOVES,
    # Food boxes before a static structured-light camera.
    "maizena2f_c1_004_005": Expectation(
        {"whole box": (0.49, 0.40, 0.585, 0.605)}, cameras=("static",), min_cover=0.85
    ),
    "maizena2f_c1_010_011": Expectation({"box": (0.23, 0.55, 0.40, 0.85)}, cameras=("static",)),
    "maizena2f_c2_003_004": Expectation({"box": (0.49, 0.17, 0.63, 0.46)}, cameras=("static",)),
    "maizena2f_c2_005_006": Expectation({"box": (0.61, 0.30, 0.77, 0.56)}, cameras=("static",)),
    "boxes_still": STATIC_ROOM,
    # Rooms and people.
    "tumrpy_025_030": HANDHELD_ROOM,
    "tumrpy_100_105": HANDHELD_ROOM,
    "open3d_000_001": HANDHELD_ROOM,
    "merge3d_003_004": HANDHELD_ROOM,
    "slambook5_001_002": HANDHELD_ROOM,
    "tsdf_039_049": HANDHELD_ROOM,
    "pan": HANDHELD_ROOM,
    "pivimages3_c1_001_002": STATIC_ROOM,
    "cupdata_078_082": Expectation(allowed=((0.1, 0.4, 0.9, 1.0),), max_displacement=1.0),
    "robot": Expectation(anywhere=True),
    "person_standing": Expectation(anywhere=True),
    # Rendered tables.
    "white-table-still": STATIC_ROOM,
    "exposure-gamma-wb-still": STATIC_ROOM,
    "crop-off-center": Expectation({"box": (0.16, 0.16, 0.56, 0.62)}),
    "far-4x": Expectation({"left box": (0.27, 0.45, 0.41, 0.64), "right box": (0.59, 0.44, 0.75, 0.64)}),
}
"""The pairs by the names of their folders."""
