"""Rejection sampling: a scene is drawn again until an attempt is accepted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from objectflow.errors import DatasetError
from objectflow.synth.generation.stage_timer import StageTimer
from objectflow.synth.generation.tasks import SceneRows
from objectflow.synth.physics.simulate import RejectedSceneError

MAX_ATTEMPTS = 50
"""Attempts per scene before generation fails."""

DrawRows = Callable[[np.random.Generator, StageTimer, Callable[[str], None]], list[dict[str, Any]]]
"""Makes one attempt and returns its rows. The timer is running; the last argument takes a note per skipped model."""


def draw_until_accepted(rng: np.random.Generator, draw: DrawRows, *, where: str, notes: Sequence[str]) -> SceneRows:
    """Repeat attempts until one is accepted.

    Args:
        rng: the scene's random generator; each attempt continues its stream.
        draw: makes the rows of one attempt, or raises RejectedSceneError.
        where: name of the scene in messages.
        notes: messages that every scene passes on, such as the broken meshes of the library.

    Raises:
        DatasetError: `MAX_ATTEMPTS` attempts were rejected.
    """
    rejected: dict[str, int] = {}
    messages = list(notes)
    timer = StageTimer()
    for _ in range(MAX_ATTEMPTS):
        try:
            timer.start()
            rows = draw(rng, timer, messages.append)
            return SceneRows(rows, rejected, tuple(dict.fromkeys(messages)), timer.seconds)
        except RejectedSceneError as error:
            rejected[error.reason] = rejected.get(error.reason, 0) + 1
    raise DatasetError(f"{where}: {MAX_ATTEMPTS} attempts were rejected ({rejected}): check the settings")
