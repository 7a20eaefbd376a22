"""Frames as they come: the newest one for a method that is slower than the camera, and a clock for recordings."""

from objectflow.live.latest import Latest
from objectflow.live.replay import replay
from objectflow.live.session import Step, follow

__all__ = ["Latest", "Step", "follow", "replay"]
