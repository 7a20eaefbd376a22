"""Physics against analytic falls, both engines against each other, and the reasons for rejection."""

from __future__ import annotations

import math
import sys
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from helpers.object_models import ball_model, box_model, place, scene_of
from objectflow.errors import DatasetError, MissingExtraError
from objectflow.synth.objects.procedural import CATEGORIES, ProceduralLibrary
from objectflow.synth.physics.recording import Recording
from objectflow.synth.physics.simulate import (
    PAIR_FRAMES,
    SEQUENCE_FRAMES,
    RejectedSceneError,
    check_recording,
    simulate,
)
from objectflow.synth.scenes.paper_scene import SceneSettings, draw_paper_scene
from objectflow.typing import Float64Array

pytest.importorskip("mujoco", reason="physics needs the extra [synth]")

ENGINES = ("mujoco", "bullet")


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> Literal["mujoco", "bullet"]:
    if request.param == "bullet":
        pytest.importorskip("pybullet", reason="this engine needs the extra [bullet]")
    name: Literal["mujoco", "bullet"] = request.param
    return name


def test_a_fall_is_damped_as_in_bullet(engine: Literal["mujoco", "bullet"]) -> None:
    """v' = -g - c v with c = -ln(1 - 0.9): z = z0 + g (1 - e^(-ct)) / c^2 - g t / c."""
    model = box_model(0.05, 0.03, 0.02)
    turned = Rotation.from_rotvec((0.3, -0.4, 1.0))
    start = place(model, (0.1, -0.2, 0.9), turned)
    frames = (0, 5, 10, 15)
    poses = simulate(scene_of(start), [model], frames, engine).world_T_object[:, 0]
    c = -math.log(1 - 0.9)
    for pose, frame in zip(poses, frames, strict=True):
        t = frame / 60
        z = 0.9 + 9.81 * (1 - math.exp(-c * t)) / c**2 - 9.81 * t / c
        # Semi-implicit Euler uses the speed at the end of each step of 1/360 s: the fall is g t / 720 longer.
        assert pose[2, 3] == pytest.approx(z - 9.81 * t / 720, abs=3e-4)
        np.testing.assert_allclose(pose[:2, 3], (0.1, -0.2), atol=1e-6)
        np.testing.assert_allclose(pose[:3, :3], turned.as_matrix(), atol=1e-6)
    assert poses[-1, 2, 3] > 0.9 - 9.81 * 0.25**2 / 2 + 0.04  # height without damping


def test_a_box_comes_to_rest_on_the_floor(engine: Literal["mujoco", "bullet"]) -> None:
    model = box_model(0.05, 0.03, 0.02)
    trajectory = simulate(scene_of(place(model, (0, 0, 0.11), scale=1.5)), [model], (0, 60, 90), engine)
    before, after = trajectory.world_T_object[1:, 0]
    assert after[2, 3] == pytest.approx(0.03, abs=1e-3)
    np.testing.assert_allclose(after[:3, :3], np.eye(3), atol=0.01)
    np.testing.assert_allclose(after, before, atol=5e-4)
    assert 0 <= trajectory.penetration < 1e-3
    start = trajectory.world_T_object[0, 0]
    assert np.linalg.norm(after[:3, 3] - start[:3, 3]) == pytest.approx(0.08, abs=1e-3)


def test_the_engines_agree_on_a_box_that_topples() -> None:
    """A tall box on its edge, beyond its tipping point, falls to the same side and comes to rest at the same place."""
    pytest.importorskip("pybullet", reason="the comparison needs the extra [bullet]")
    model = box_model(0.03, 0.04, 0.1)
    lean = Rotation.from_euler("y", math.atan2(0.03, 0.1) + 0.15)
    lowest = (model.vertices @ lean.as_matrix().T)[:, 2].min()
    scene = scene_of(place(model, (0, 0, -lowest), lean))
    ends = [simulate(scene, [model], (0, 90), name).world_T_object[-1, 0] for name in ("mujoco", "bullet")]
    for end in ends:
        assert end[2, 3] == pytest.approx(0.03, abs=2e-3)  # on its side
        assert end[0, 3] > 0.05
    np.testing.assert_allclose(ends[0][:3, 3], ends[1][:3, 3], atol=0.01)
    np.testing.assert_allclose(ends[0][:3, :3], ends[1][:3, :3], atol=0.05)


@pytest.mark.parametrize("category", ["cup", "pot"])
def test_objects_fall_into_vessels(category: str) -> None:
    library = ProceduralLibrary()
    refs = library.refs("train")
    vessel = library.load(refs[CATEGORIES.index(category)])
    top = float(vessel.vertices[:, 2].max())
    width = float(np.ptp(vessel.vertices[:, :2], axis=0).min())
    ball = ball_model(width / 8)
    low = -float(vessel.vertices[:, 2].min())
    scene = scene_of(place(vessel, (0, 0, low + 1e-3)), place(ball, (0, 0, low + top + 0.05)))
    end = simulate(scene, [vessel, ball], PAIR_FRAMES).world_T_object[-1]
    inside = np.linalg.inv(end[0]) @ end[1]
    assert inside[2, 3] < 0.5 * top
    assert inside[2, 3] > -low
    assert np.linalg.norm(inside[:2, 3]) < width / 2


def test_the_same_scene_falls_the_same_way_and_loses_energy() -> None:
    library = ProceduralLibrary()
    scene, models = draw_paper_scene(np.random.default_rng(2), library, "train", SceneSettings(objects=(6, 6)))
    first, second = simulate(scene, models, SEQUENCE_FRAMES), simulate(scene, models, SEQUENCE_FRAMES)
    np.testing.assert_array_equal(first.world_T_object, second.world_T_object)
    assert first.frames == SEQUENCE_FRAMES
    assert first.energy_gain < 1e-3
    # Poses do not depend on which other frames are requested.
    pair = simulate(scene, models, PAIR_FRAMES)
    np.testing.assert_array_equal(pair.world_T_object[0], first.world_T_object[0])
    rotation = first.world_T_object[..., :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(-1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-9
    )


def recording(position: Float64Array, energy: Float64Array | None = None, depth: float = 0.0) -> Recording:
    """A recording of one object at positions (L + 1, 3)."""
    poses = np.tile(np.eye(4), (len(position), 1, 1, 1))
    poses[:, 0, :3, 3] = position
    energies = np.linspace(1, 0.5, len(position)) if energy is None else energy
    return Recording(poses, np.full(len(position), depth), energies)


def path(**axes: NDArray[Any]) -> Float64Array:
    result = np.tile((0.0, 0.0, 0.1), (91, 1))
    for axis, values in axes.items():
        result[:, "xyz".index(axis)] = values
    return result


TIME = np.arange(91) / 60


def test_sound_recordings_pass() -> None:
    static = check_recording(recording(path()), PAIR_FRAMES)
    assert static.world_T_object.shape == (2, 1, 4, 4)
    # Rolling away, and rocking at 6 Hz by a centimetre, are realistic.
    check_recording(recording(path(x=0.4 * TIME)), PAIR_FRAMES)
    check_recording(recording(path(x=0.01 * np.sin(2 * np.pi * 6 * TIME))), PAIR_FRAMES)


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (recording(path(x=1.0 * TIME)), "escapes"),
        (recording(path(z=0.1 - 0.1 * TIME)), "escapes"),
        (recording(path(), depth=0.01), "sinks"),
        (recording(path(), energy=np.linspace(1, 1.9, 91) ** 4), "explodes"),
        (recording(path(x=np.where(TIME[30] == TIME, 0.2, 0))), "explodes"),
        (recording(path(y=np.where(TIME > 1, np.nan, 0))), "explodes"),
        (recording(path(x=0.0005 * (-1) ** np.arange(91))), "jitters"),
    ],
)
def test_the_reason_for_rejection_is_named(broken: Recording, reason: str) -> None:
    with pytest.raises(RejectedSceneError) as raised:
        check_recording(broken, PAIR_FRAMES)
    assert raised.value.reason == reason
    assert "\n" not in str(raised.value)


def test_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    model = box_model(0.05, 0.05, 0.05)
    scene = scene_of(place(model, (0, 0, 0.1)))
    for frames in ((), (20, 20), (80, 20), (-1, 5)):
        with pytest.raises(DatasetError, match="frames must rise"):
            simulate(scene, [model], frames)
    with pytest.raises(DatasetError, match="choose mujoco or bullet"):
        simulate(scene, [model], (0,), "physx")  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[bullet\]"'):
        simulate(scene, [model], (0,), "bullet")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[synth\]"'):
        simulate(scene, [model], (0,))


def test_every_category_falls_and_comes_to_rest_without_sinking() -> None:
    """One model of each of the 28 categories, far apart from each other."""
    library = ProceduralLibrary()
    models = [library.load(ref) for ref in library.refs("test")[: len(CATEGORIES)]]
    rng = np.random.default_rng(0)
    for start in range(0, len(models), 7):
        some = models[start : start + 7]
        objects = [
            place(model, (0.35 * (i % 3) - 0.35, 0.35 * (i // 3) - 0.35, 0.25), Rotation.from_quat(rng.normal(size=4)))
            for i, model in enumerate(some)
        ]
        end = simulate(scene_of(*objects), some, PAIR_FRAMES).world_T_object[-1]
        for model, pose in zip(some, end, strict=True):
            lowest = (model.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min()
            assert -0.003 < lowest < 0.02, model.name
