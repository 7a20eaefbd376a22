"""Layout of the rerun viewer: a large 3D view with objects or flow as tabs, and the images beside it."""

from __future__ import annotations

from objectflow.view.rerun_sdk import rr, rrb

CAMERA = "world/camera"
FRAME = "frame"
"""The timeline of frame numbers."""


def make_layout() -> rrb.Blueprint:
    """The layout that a new recording opens with."""
    # The labels' own view has no image below them, so they are opaque.
    labels = rrb.Spatial2DView(
        origin=CAMERA,
        contents=[f"+ /{CAMERA}/labels"],
        name="Labels",
        overrides={f"{CAMERA}/labels": rr.SegmentationImage.from_fields(opacity=1.0)},
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(_world_view("Objects", "by_flow"), _world_view("Flow", "by_object"), active_tab=0),
            rrb.Vertical(_image_view("Colour with masks", "color", "labels"), _image_view("Depth", "depth"), labels),
            column_shares=[2.4, 1],
        ),
        rrb.BlueprintPanel(expanded=False),
        rrb.SelectionPanel(expanded=False),
        rrb.TimePanel(expanded=False, timeline=FRAME, fps=2.0),
    )


def _world_view(name: str, hidden_points: str) -> rrb.Spatial3DView:
    # The depth image is hidden because rerun would draw it as a second point cloud.
    hidden = [f"- /{CAMERA}/depth", f"- /{CAMERA}/labels", f"- /world/points/{hidden_points}"]
    return rrb.Spatial3DView(
        origin="world",
        contents=["+ $origin/**", *hidden],
        name=name,
        background=[255, 255, 255],
        line_grid=False,
        # Above and to the right of the first camera, facing the scene.
        eye_controls=rrb.EyeControls3D(position=(0.35, -0.35, -0.25), look_target=(0, 0, 0.8), eye_up=(0, -1, 0)),
    )


def _image_view(name: str, *parts: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=CAMERA, contents=[f"+ /{CAMERA}/{part}" for part in parts], name=name)
