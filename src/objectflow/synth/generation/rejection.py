"""What all makers of scenes share: an open library, and drawing anew until a draft holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from objectflow.errors import DatasetError
from objectflow.synth.generation.rows import Clock
from objectflow.synth.generation.tasks import SceneRows
from objectflow.synth.objects.library import Library
from objectflow.synth.objects.mixed_library import Meshes, open_mixed
from objectflow.synth.physics.simulate import RejectedSceneError

MAX_DRAFTS = 50

Draw = Callable[[np.random.Generator, Clock, Callable[[str], None]], list[dict[str, Any]]]
"""One draft: its rows; the clock is running; models that are left out are told."""


def library_and_broken(meshes: Meshes | None) -> tuple[Library, list[str]]:
    """The library, and a line for each mesh of the folder that it has sorted out as broken."""
    library = open_mixed(meshes)
    # The procedural library has nothing broken.
    found: dict[str, str] = getattr(library, "broken", {})
    return library, [f"{name}: skipped: {reason}" for name, reason in sorted(found.items())]


def draw_until_kept(rng: np.random.Generator, draw: Draw, *, where: str, broken: list[str], clock: Clock) -> SceneRows:
    """Draw drafts until one is not rejected.

    Args:
        rng: of the scene; each draft goes on where the last one stopped.
        draw: makes the rows of one draft, or raises RejectedSceneError.
        where: how messages name the scene.
        broken: lines about models that were left out before.
        clock: started at each draft.

    Raises:
        DatasetError: too many drafts were rejected.
    """
    rejected: dict[str, int] = {}
    skipped = list(broken)
    for _ in range(MAX_DRAFTS):
        try:
            clock.start()
            rows = draw(rng, clock, skipped.append)
            return SceneRows(rows, rejected, tuple(dict.fromkeys(skipped)), clock.seconds)
        except RejectedSceneError as error:
            rejected[error.reason] = rejected.get(error.reason, 0) + 1
    raise DatasetError(f"{where}: {MAX_DRAFTS} drafts were rejected ({rejected}): check the settings")
