"""Tracking of objects over a sequence: persistent ids, trajectories and their files."""

from objectflow.tracking.tracker import Track, Tracker, TrackerSettings

__all__ = ["Track", "Tracker", "TrackerSettings"]
