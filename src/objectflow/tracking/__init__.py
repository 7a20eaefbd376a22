"""Objects followed over a recording: ids that last, trajectories, and their files."""

from objectflow.tracking.tracker import Track, Tracker, TrackerSettings

__all__ = ["Track", "Tracker", "TrackerSettings"]
