"""The rows of the paper's two tables of results (Shao, Shah, Dwaracherla, Bohg, RA-L 2018).

The paper's data differ from ours in object models, renderer and test scenes; its runtimes were measured elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

SOURCE = "Shao et al., RA-L 2018, printed values on the paper's own data"
"""Origin of the rows, for the tables' notes."""


class PaperFlow(NamedTuple):
    """A row of the table of scene flow: means and standard deviations in cm and degrees, and seconds per pair."""

    method: str
    epe_all: tuple[float, float]
    epe_masked: tuple[float, float]
    aae_all: tuple[float, float]
    aae_masked: tuple[float, float]
    seconds: str


class PaperSegmentation(NamedTuple):
    """A row of the table of segmentation, on Test or TestSeq."""

    method: str
    precision: float
    recall: float
    f: float
    extracted: int


FLOW = (
    PaperFlow("PD-Flow", (2.830, 4.23), (8.041, 5.10), (1.607, 2.38), (4.572, 2.87), "0.046"),
    PaperFlow("SR-Flow", (2.040, 3.77), (6.859, 4.69), (1.155, 2.12), (3.898, 2.63), ">= 1"),
    PaperFlow("VO-SF", (2.330, 3.94), (6.431, 5.20), (1.317, 2.20), (3.643, 2.91), "0.083"),
    PaperFlow("OurS", (1.643, 3.07), (5.324, 3.56), (0.928, 1.72), (3.020, 2.00), "0.059"),
    PaperFlow("OurC", (1.330, 2.60), (4.333, 2.92), (0.750, 1.45), (2.457, 1.64), "0.078"),
    PaperFlow("OurC+vL", (1.315, 2.57), (4.333, 2.95), (0.742, 1.44), (2.457, 1.66), "0.078"),
    PaperFlow("OurC+vL+Rig", (1.303, 2.55), (4.290, 2.93), (0.734, 1.43), (2.432, 1.64), "0.121"),
)

TEST_OBJECTS, TEST_SEQ_OBJECTS = 64556, 11782

TEST = (
    PaperSegmentation("HOMC", 0.833, 0.195, 0.111, 3909),
    PaperSegmentation("OurS", 0.697, 0.735, 0.671, 36369),
    PaperSegmentation("OurC", 0.756, 0.757, 0.696, 41274),
    PaperSegmentation("OurC+vL", 0.766, 0.787, 0.730, 43719),
)

TEST_SEQ = (
    PaperSegmentation("HOMC", 0.797, 0.282, 0.186, 1172),
    PaperSegmentation("OurS", 0.714, 0.749, 0.683, 7077),
    PaperSegmentation("OurC", 0.763, 0.771, 0.711, 7839),
    PaperSegmentation("OurC+vL", 0.768, 0.783, 0.725, 8015),
)
