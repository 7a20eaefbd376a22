"""Scenes of the preset `tabletop`: what recordings with depth cameras over tables show.

Plain light tables with hard shadows, food packages and other objects, hands that carry them, and light that changes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.dataset.manifest import SPLITS
from objectflow.errors import DatasetError
from objectflow.synth.objects.arms import Arm, build_arm
from objectflow.synth.objects.library import Library
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.objects.packages import build_package
from objectflow.synth.objects.shadow_casters import build_shadow_caster
from objectflow.synth.rendering.color_response import ResponseSettings
from objectflow.synth.scenes.actions import Action, ActionKind, draw_action
from objectflow.synth.scenes.appearance import draw_floor, draw_surface
from objectflow.synth.scenes.arm_motion import HELD_KINDS, ArmPlan, draw_arm_plan
from objectflow.synth.scenes.clutter_scene import LAST_START, draw_number, draw_rotations, draw_view
from objectflow.synth.scenes.initial_layout import bounding_boxes, covered_radius, place_objects
from objectflow.synth.scenes.light_changes import draw_hard_lights
from objectflow.synth.scenes.paper_scene import (
    Range,
    SceneSettings,
    check_scene_settings,
    draw_intrinsics,
    draw_scale,
    load_random_model,
)
from objectflow.synth.scenes.scene_data import Scene, SceneObject
from objectflow.synth.scenes.surroundings import draw_surroundings
from objectflow.synth.scenes.table_surfaces import draw_background, draw_sheets, draw_table_surface, surface_slabs
from objectflow.synth.scenes.textures import TextureSpec, list_images
from objectflow.typing import BoolMask

MAX_RADIUS = 0.4
"""Maximum radius of the disc on which objects are placed, metres."""
KINDS: tuple[ActionKind, ...] = ("slide", "carry", "turn", "lift", "push", "topple", "fall")
KIND_PROBABILITIES = (0.24, 0.24, 0.12, 0.1, 0.1, 0.08, 0.12)
"""Probability of each kind of action, in the order of `KINDS`."""
SCENE = SceneSettings(
    objects=(1, 12),
    size=(0.04, 0.34),
    size_jitter=1.3,
    drop_height=0.01,
    focal=(215.0, 310.0),
    principal_shift=6.0,
    distance=(0.4, 1.5),
    elevation=(16.0, 85.0),
    roll=(-8.0, 8.0),
    lights=(1, 3),
    image_share=0.35,
)
"""Objects, appearance and cameras of the preset."""


@dataclass(frozen=True)
class TabletopSettings:
    """Distributions that tabletop scenes are drawn from."""

    scene: SceneSettings = field(default_factory=lambda: SCENE)
    """Objects, appearance and cameras; `spread` is not used."""
    response: ResponseSettings = field(default_factory=ResponseSettings)
    """Response of the colour camera and its change between the frames."""
    spread: Range = (0.8, 2.6)
    """Radius of the disc in which objects start, as in `SceneSettings`."""
    upright: float = 0.7
    """Share of upright objects, 0..1; the others have any orientation."""
    packages: float = 0.25
    """Share of objects that are long printed boxes, 0..1."""
    actions: tuple[int, int] = (1, 3)
    """Minimum and maximum number of objects that are acted upon in a scene with motion."""
    movers: tuple[int, int] = (1, 8)
    """Minimum and maximum number of moving objects in a pair with motion, arms included."""
    package_path: Range = (0.1, 0.3)
    """Distance by which packages are slid or carried, metres."""
    path: Range = (0.02, 0.25)
    """Distance by which other objects are slid or carried, metres."""
    arms: tuple[float, float, float] = (0.35, 0.45, 0.2)
    """Probabilities of no, one and two arms."""
    holding: float = 0.8
    """Share of arms that carry out an action, 0..1, as long as there are actions for them."""
    visible_shoulders: float = 0.15
    """Share of views that are accepted although an arm's end, where the body is missing, is in the image, 0..1."""
    resting: float = 0.25
    """Share of the other arms that do not move, 0..1."""
    motionless: float = 0.13
    """Share of scenes in which nothing moves but light and shadows, 0..1."""
    gap: tuple[int, int] = (3, 60)
    """Minimum and maximum number of frames, at 60 Hz, between the two frames of a pair."""
    moving_camera: float = 0.33
    """Share of pairs with a moving camera, 0..1."""
    camera_turn: Range = (0.3, 8.0)
    """Rotation of a moving camera, degrees."""
    camera_shift: Range = (0.003, 0.08)
    """Translation of a moving camera, metres."""
    plain_tables: float = 0.6
    """Share of tables with a plain light surface, 0..1."""
    object_images: float = 0.3
    """Share of objects with an image as texture, 0..1, where there is a folder of images."""
    relit: float = 0.5
    """Share of pairs whose lamps change between the frames, 0..1."""
    shadows: float = 0.45
    """Share of pairs with the shadow of a body outside the view, 0..1."""
    scaled: float = 0.4
    """Share of scenes that are scaled as a whole, camera included, 0..1."""
    scale: Range = (0.38, 3.0)
    """Range of the factor of scaled scenes, uniform in its logarithm; depth then covers about 0.15 to 4.5 m."""

    def __post_init__(self) -> None:
        check_scene_settings(self.scene)
        if not 1 <= self.movers[0] <= self.movers[1] or not 1 <= self.gap[0] <= self.gap[1]:
            raise DatasetError(
                f"tabletop settings: movers and gap are ranges from 1 up, not {self.movers}, {self.gap}"
            )
        if not 1 <= self.actions[0] <= self.actions[1]:
            raise DatasetError(f"tabletop settings: actions is a range from 1 up, not {self.actions}")
        shares = (
            self.upright, self.packages, self.holding, self.resting, self.motionless, self.moving_camera,
            self.visible_shoulders, self.plain_tables, self.object_images, self.relit, self.shadows, self.scaled,
            *self.arms,
        )  # fmt: skip
        if not all(0 <= share <= 1 for share in shares) or not math.isclose(sum(self.arms), 1):
            raise DatasetError("tabletop settings: shares must be within 0 and 1, and those of `arms` must sum to 1")


@dataclass(frozen=True, eq=False)
class TabletopScene:
    """A scene before its scaling.

    Attributes:
        scene: its objects are first those that physics moves, then the arms, then one shadow caster.
        models: of all objects.
        actions: on objects that physics moves; none in a scene without motion.
        arms: each arm and its motion.
        radius: of the disc of objects, metres.
        scale: factor on all lengths.
    """

    scene: Scene
    models: tuple[ObjectModel, ...]
    actions: tuple[Action, ...]
    arms: tuple[tuple[Arm, ArmPlan], ...]
    radius: float
    scale: float

    @property
    def free(self) -> int:
        """Number of objects that physics moves."""
        return len(self.models) - len(self.arms) - 1


def draw_tabletop_scene(
    rng: np.random.Generator,
    library: Library,
    split: str,
    settings: TabletopSettings,
    skip: Callable[[str], None] | None = None,
    *,
    motionless: bool = False,
) -> TabletopScene:
    """Draw a scene.

    Args:
        rng, library, split, skip, motionless: see `objectflow.synth.scenes.clutter_scene.draw_clutter_scene`.
        settings: distributions that the scene is drawn from.

    Raises:
        DatasetError: an unknown split, or a library whose models cannot be loaded.
    """
    plain = settings.scene
    acting = 0 if motionless else draw_number(rng, *settings.actions)
    count = max(acting, draw_number(rng, *plain.objects))
    packages = rng.random(count) < settings.packages
    models = [
        build_package(_draw_model_number(rng, split)) if package else load_random_model(rng, library, split, skip)
        for package in packages
    ]
    scales = [
        1.0 if package else draw_scale(rng, model, plain) for package, model in zip(packages, models, strict=True)
    ]
    actions = _draw_actions(rng, acting, packages, settings)
    rotations = draw_rotations(rng, count, settings.upright)
    boxes = bounding_boxes(models, scales)
    radius = min(MAX_RADIUS, float(rng.uniform(*settings.spread)) * covered_radius(boxes[1]))
    origins = place_objects(rng, rotations.as_matrix(), boxes, plain.drop_height, radius, tries=8)
    surroundings = draw_surroundings(rng, radius, tables=0.85, bins=0.08)
    images = list_images(plain.images) if plain.images is not None else []
    falling = {action.object for action in actions if action.kind == "fall"}
    objects = []
    for k, (model, scale) in enumerate(zip(models, scales, strict=True)):
        lift = float(rng.uniform(0.05, 0.2)) if k in falling else 0.0
        item = _draw_object(rng, model, scale, settings, images)
        x, y, z = map(float, origins[k])
        w, qx, qy, qz = map(float, rotations[k].as_quat(scalar_first=True))
        objects.append(dataclasses.replace(item, position=(x, y, z + lift), quaternion=(w, qx, qy, qz)))
    arms = _draw_arms(rng, split, actions, surroundings.front, radius, settings)
    caster = build_shadow_caster(_draw_model_number(rng, split))
    others = [*(arm.model for arm, _ in arms), caster]
    objects += [_draw_object(rng, model, 1.0, settings, []) for model in others]
    slabs = surroundings.slabs + draw_background(rng, surroundings, radius) + draw_sheets(rng, radius)
    table = draw_table_surface(rng, images, plain.image_share, settings.plain_tables)
    on_floor = surroundings.floor == 0
    floor = table if on_floor else draw_floor(rng, images, plain.image_share)
    scene = Scene(
        objects=tuple(objects),
        floor=dataclasses.replace(floor, height=surroundings.floor, half=3.0, pixels=256),
        lights=draw_hard_lights(rng, plain.lights),
        intrinsics=draw_intrinsics(rng, plain),
        views=tuple(draw_view(rng, plain, surroundings) for _ in range(plain.views)),
        slabs=surface_slabs(rng, slabs, table, images, plain.image_share),
    )
    low, high = (math.log(limit) for limit in settings.scale)
    factor = math.exp(rng.uniform(low, high)) if rng.random() < settings.scaled else 1.0
    return TabletopScene(scene, (*models, *others), tuple(actions), tuple(arms), radius, factor)


def _draw_model_number(rng: np.random.Generator, split: str) -> int:
    """Draw the number of a package, an arm or a shadow caster; the splits' numbers are disjoint."""
    return len(SPLITS) * int(rng.integers(300_000)) + SPLITS.index(split)


def _draw_actions(
    rng: np.random.Generator, acting: int, packages: BoolMask, settings: TabletopSettings
) -> list[Action]:
    """Draw actions on different objects; falling objects come last, so that they start above all others."""
    count = len(packages)
    kinds = sorted(
        (KINDS[int(rng.choice(len(KINDS), p=KIND_PROBABILITIES))] for _ in range(acting)),
        key=lambda kind: kind == "fall",
    )
    falling = sum(kind == "fall" for kind in kinds)
    targets = [*map(int, rng.permutation(count - falling)[: acting - falling]), *range(count - falling, count)]
    actions = []
    for kind, target in zip(kinds, targets, strict=True):
        action = dataclasses.replace(draw_action(rng, target, LAST_START), kind=kind)
        path = float(rng.uniform(*(settings.package_path if packages[target] else settings.path)))
        angle = float(rng.choice((-1, 1)) * rng.uniform(0.0, 1.6))
        tilt = float(rng.uniform(-0.6, 0.6))
        changes: dict[str, dict[str, Any]] = {
            "slide": {"path": path, "angle": angle},
            "carry": {"path": path, "angle": angle, "rise": float(rng.uniform(0.02, 0.2))},
            "turn": {"path": 0.0, "angle": angle + math.copysign(0.3, angle)},
            "lift": {"path": float(rng.uniform(0.03, 0.25)), "angle": tilt},
            "topple": {"path": 0.0, "angle": float(rng.uniform(0.5, 1.1)), "frames": int(rng.integers(8, 20))},
        }
        actions.append(dataclasses.replace(action, **changes.get(kind, {"path": 0.0, "angle": 0.0})))
    return actions


def _draw_arms(
    rng: np.random.Generator,
    split: str,
    actions: Sequence[Action],
    front: float,
    radius: float,
    settings: TabletopSettings,
) -> list[tuple[Arm, ArmPlan]]:
    """Draw the arms of a scene; most of them come from one side, as those of one person do."""
    waiting = [action for action in actions if action.kind in HELD_KINDS]
    side = front + float(rng.uniform(-math.pi, math.pi))
    arms = []
    for _ in range(int(rng.choice(3, p=settings.arms))):
        held = waiting.pop() if waiting and rng.random() < settings.holding else None
        still = held is None and (not actions or rng.random() < settings.resting)
        arms.append((build_arm(_draw_model_number(rng, split)), draw_arm_plan(rng, held, side, radius, still)))
    return arms


def _draw_object(
    rng: np.random.Generator, model: ObjectModel, scale: float, settings: TabletopSettings, images: Sequence[Path]
) -> SceneObject:
    """Draw an object's appearance and density, at the origin."""
    texture, specular, shininess = draw_surface(rng, model.texture is not None)
    if model.category == "package":
        texture = dataclasses.replace(texture, kind="package")
    elif rng.random() < settings.object_images and images and model.texture is None:
        texture = TextureSpec("image", path=str(images[int(rng.integers(len(images)))]))
    if model.category == "arm":
        specular, shininess = 0.05, 0.1
    return SceneObject(
        category=model.category,
        name=model.name,
        scale=scale,
        density=float(rng.uniform(*settings.scene.density)),
        position=(0.0, 0.0, 0.0),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        texture=texture,
        specular=specular,
        shininess=shininess,
    )


def scaled_scene(scene: Scene, factor: float) -> Scene:
    """The scene with all lengths multiplied by a factor, cameras and lights included."""
    return dataclasses.replace(
        scene,
        objects=tuple(
            dataclasses.replace(item, scale=item.scale * factor, position=_times(item.position, factor))
            for item in scene.objects
        ),
        floor=dataclasses.replace(
            scene.floor,
            tile=scene.floor.tile * factor,
            height=scene.floor.height * factor,
            half=scene.floor.half * factor,
        ),
        lights=tuple(dataclasses.replace(light, position=_times(light.position, factor)) for light in scene.lights),
        views=tuple(
            dataclasses.replace(view, target=_times(view.target, factor), distance=view.distance * factor)
            for view in scene.views
        ),
        slabs=tuple(
            dataclasses.replace(
                slab,
                center=_times(slab.center, factor),
                half=_times(slab.half, factor),
                surface=dataclasses.replace(slab.surface, tile=slab.surface.tile * factor),
            )
            for slab in scene.slabs
        ),
    )


def _times(vector: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    return vector[0] * factor, vector[1] * factor, vector[2] * factor
