"""Checks of two frames for common input errors, before any method runs: `objectflow check` and `check-pair`."""

from objectflow.diagnosis.finding import Finding, Level
from objectflow.diagnosis.overlay import draw_depth_edges
from objectflow.diagnosis.pair import examine
from objectflow.diagnosis.quick import examine_quickly
from objectflow.diagnosis.source import ReadPair, examine_source, read_pair

__all__ = [
    "Finding",
    "Level",
    "ReadPair",
    "draw_depth_edges",
    "examine",
    "examine_quickly",
    "examine_source",
    "read_pair",
]
