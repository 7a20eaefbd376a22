"""Publication-quality pictures of a result."""

from objectflow.view.flow import draw_flow
from objectflow.view.overlay import draw_overlay
from objectflow.view.pictures import write_pictures

__all__ = ["draw_flow", "draw_overlay", "write_pictures"]
