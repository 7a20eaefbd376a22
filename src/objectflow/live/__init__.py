"""Frames as they come: the newest one for a method that is slower than the camera, and a clock for recordings."""

from objectflow.live.follow import Step, follow
from objectflow.live.newest_frame import NewestFrame
from objectflow.live.replay import replay

__all__ = ["NewestFrame", "Step", "follow", "replay"]
