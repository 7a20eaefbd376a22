"""Checks of two frames for common input errors, before any method runs: `objectflow check-pair`."""

from objectflow.diagnosis.finding import Finding, Level
from objectflow.diagnosis.pair import examine

__all__ = ["Finding", "Level", "examine"]
