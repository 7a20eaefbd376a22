"""Time spent in each stage of a scene's generation."""

from __future__ import annotations

import time

STAGES = ("draw", "build", "physics", "render", "encode")


class StageTimer:
    """Accumulates seconds per stage; rejected attempts count too."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._since = time.perf_counter()

    def start(self) -> None:
        """Start the first stage now."""
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last call to a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._since
        self._since = now
