"""Tracking of objects over a sequence: persistent ids, trajectories and their files."""

from objectflow.tracking.bounding_box import OrientedBox
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.sequence_estimator import SequenceEstimator, SequenceStep
from objectflow.tracking.track import Track
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.tracker_settings import TrackerSettings

__all__ = ["KnownSettings", "OrientedBox", "SequenceEstimator", "SequenceStep", "Track", "Tracker", "TrackerSettings"]
