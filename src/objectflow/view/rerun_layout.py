"""Layout of the rerun viewer: a large 3D view with objects or flow as tabs, and the images beside it."""

from __future__ import annotations

from objectflow.view.rerun_sdk import rr, rrb

CAMERA = "world/camera"
FRAME = "frame"
"""The timeline of frame numbers."""


POINTS = "world/points"
MODELS = "world/models"


def make_layout(*, models: bool = False) -> rrb.Blueprint:
    """The layout that a new recording opens with.

    Args:
        models: with a tab for the models of objects.
    """
    # The labels' own view has no image below them, so they are opaque.
    labels = rrb.Spatial2DView(
        origin=CAMERA,
        contents=[f"+ /{CAMERA}/labels"],
        name="Labels",
        overrides={f"{CAMERA}/labels": rr.SegmentationImage.from_fields(opacity=1.0)},
    )
    views = [
        _world_view("Objects", "by_object"),
        _world_view("Flow", "by_flow"),
        _world_view("Colour", "by_color/modelled", "by_color/rest"),
    ]
    if models:
        # The models stand in for the points of their objects.
        views.append(_world_view("Models", "by_color/rest", models=True))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*views, active_tab=len(views) - 1 if models else 0),
            rrb.Vertical(_image_view("Colour with masks", "color", "labels"), _image_view("Depth", "depth"), labels),
            column_shares=[2.4, 1],
        ),
        rrb.BlueprintPanel(expanded=False),
        rrb.SelectionPanel(expanded=False),
        rrb.TimePanel(expanded=False, timeline=FRAME, fps=2.0),
    )


def _world_view(name: str, *points: str, models: bool = False) -> rrb.Spatial3DView:
    """A 3D view of everything with some of the points, and with or without models."""
    # The depth image is hidden because rerun would draw it as a second point cloud.
    contents = ["+ $origin/**", f"- /{CAMERA}/depth", f"- /{CAMERA}/labels", f"- /{POINTS}/**"]
    contents += [f"+ /{POINTS}/{part}" for part in points]
    if not models:
        contents.append(f"- /{MODELS}/**")
    return rrb.Spatial3DView(
        origin="world",
        contents=contents,
        name=name,
        background=[255, 255, 255],
        line_grid=False,
        # Above and to the right of the first camera, facing the scene.
        eye_controls=rrb.EyeControls3D(position=(0.35, -0.35, -0.25), look_target=(0, 0, 0.8), eye_up=(0, -1, 0)),
    )


def _image_view(name: str, *parts: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=CAMERA, contents=[f"+ /{CAMERA}/{part}" for part in parts], name=name)
