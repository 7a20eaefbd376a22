"""`KnownObject`: what is kept of an object that has moved."""

from __future__ import annotations

from dataclasses import dataclass, field

from objectflow.tracking.looks import Looks
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import Float64Array


@dataclass(eq=False)
class KnownObject:
    """An object that has moved at least once.

    Attributes:
        model: its accumulated surface.
        world_T_object: (4, 4) its latest pose.
        moved: whether it moved in the latest pair.
        present: share of the model's visible points that the latest frame confirmed, 0..1; 0 while it is hidden.
        looks: features on its surface.
        twin: (3,) metres in the world: centre of something else that looks the same, which was seen when the object
            came to rest; None if there was none.
        searched: number of the latest search for it, while it was lost.
    """

    model: SurfaceModel
    world_T_object: Float64Array
    moved: bool = True
    present: float = 0.0
    looks: Looks = field(default_factory=Looks)
    twin: Float64Array | None = None
    searched: int = 0
