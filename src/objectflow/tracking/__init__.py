"""Tracking of objects over a sequence: persistent ids, trajectories and their files."""

from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.sequence_estimator import SequenceEstimator, SequenceStep
from objectflow.tracking.tracker import Track, Tracker, TrackerSettings

__all__ = ["KnownSettings", "SequenceEstimator", "SequenceStep", "Track", "Tracker", "TrackerSettings"]
