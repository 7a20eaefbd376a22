"""Live processing: the newest frame for methods slower than the camera, and recordings played in real time."""

from objectflow.live.follow import Step, follow
from objectflow.live.newest_frame import NewestFrame
from objectflow.live.replay import replay

__all__ = ["NewestFrame", "Step", "follow", "replay"]
