"""The preset `wild`: what actions do, which frames make a pair, what stands around, and the rows that come of it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from objectflow import geometry
from objectflow.dataset.check import contradictions
from objectflow.dataset.moving_objects import moving_labels
from objectflow.dataset.schema import PairRow
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.generation.clutter_maker import ClutterScenes
from objectflow.synth.generation.frame_pairs import pick_moment
from objectflow.synth.generation.tasks import Task
from objectflow.synth.objects.mixed_library import MixedLibrary
from objectflow.synth.objects.model import ModelRef, ObjectModel
from objectflow.synth.objects.procedural import ProceduralLibrary
from objectflow.synth.physics.mjcf import box_mesh
from objectflow.synth.physics.recording import FRAME, Recording
from objectflow.synth.scenes.actions import KINDS, SHARES, Action, draw_action, is_led, led_velocity
from objectflow.synth.scenes.clutter_scene import SCENE, WildSettings, draw_wild_scene
from objectflow.synth.scenes.scene_data import Floor, Scene, Slab
from objectflow.synth.scenes.surroundings import draw_surroundings, is_open
from objectflow.synth.scenes.textures import TextureSpec

LOOK = Floor(TextureSpec("plain"), 1.0, 0.0, 0.1)
SMALL = WildSettings(replace(SCENE, objects=(2, 5), width=160, height=120, focal=(110.0, 150.0)))


def action(kind: str, angle: float = 0.5, path: float = 0.1) -> Action:
    return Action(kind, 0, 10, 30, 0.7, path, 0.8, angle)  # type: ignore[arg-type]


def travelled(one: Action) -> tuple[np.ndarray, np.ndarray]:
    """Path and angle of a led object, summed up over its time."""
    way, turn, sub = np.zeros(3), np.zeros(3), 50
    for k in range(60 * sub):
        velocity, spin = led_velocity(one, k / sub, FRAME, np.array([0.0, 0.0, 0.1]))
        way, turn = way + velocity * FRAME / sub, turn + spin * FRAME / sub
    return way, turn


def test_led_objects_go_as_far_and_turn_as_much_as_the_action_says() -> None:
    way, turn = travelled(action("slide"))
    np.testing.assert_allclose(way, 0.1 * np.array([math.cos(0.7), math.sin(0.7), 0]), atol=1e-6)
    np.testing.assert_allclose(turn, [0, 0, 0.5], atol=1e-6)
    way, turn = travelled(action("lift"))
    np.testing.assert_allclose(way, [0, 0, 0.1], atol=1e-6)
    np.testing.assert_allclose(turn, 0.5 * np.array([-math.sin(0.7), math.cos(0.7), 0]), atol=1e-6)
    way, turn = travelled(action("turn"))
    np.testing.assert_allclose(np.r_[way, turn], [0, 0, 0, 0, 0, 0.5], atol=1e-6)


def test_tipped_objects_go_towards_the_heading_over_an_edge_below_them() -> None:
    one = action("topple")
    velocity, spin = led_velocity(one, 25.0, FRAME, np.array([0.0, 0.0, 0.1]))
    assert velocity @ one.direction > 0
    np.testing.assert_allclose(np.linalg.norm(velocity), 0.1 * np.linalg.norm(spin))


@pytest.mark.parametrize(
    ("kind", "times"),
    [("push", []), ("slide", [15]), ("turn", [15]), ("topple", [15]), ("lift", [15, 50]), ("fall", [-1, 5])],
)
def test_when_objects_are_led(kind: str, times: list[int]) -> None:
    assert [time for time in (-1, 5, 15, 50) if is_led(action(kind), time)] == times


def test_every_kind_of_action_is_drawn() -> None:
    rng = np.random.default_rng(0)
    assert {draw_action(rng, 0, 5).kind for _ in range(200)} == set(KINDS)
    assert math.isclose(sum(SHARES), 1)


def plate(symmetry: tuple[SymmetryAxis, ...] = ()) -> ObjectModel:
    vertices, faces, uv = box_mesh((0.1, 0.1, 0.01))
    return ObjectModel("box", "box-1", vertices, faces, uv, (vertices,), symmetry)


def recording(shifts: Sequence[float], turns: Sequence[float] = (), frames: int = 61) -> Recording:
    """Objects that go along x, or turn about z, evenly; the numbers are those of the last frame."""
    poses = np.tile(np.eye(4), (frames, max(len(shifts), len(turns)), 1, 1))
    share = np.linspace(0, 1, frames)
    for k, shift in enumerate(shifts):
        poses[:, k, 0, 3] = share * shift
    for k, turn in enumerate(turns):
        poses[:, k, :3, :3] = geometry.so3_exp(np.outer(share, [0, 0, turn]))
    return Recording(poses, np.zeros(frames), np.zeros(frames))


def pick(made: Recording, models: Sequence[ObjectModel], movers: tuple[int, int] = (1, 8)):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    return pick_moment(rng, made, models, [1.0] * len(models), gap=(60, 60), movers=movers)


def test_what_hardly_moves_is_put_where_it_was_and_what_moves_stays() -> None:
    made = recording([0.0024, 0.0051])
    moment = pick(made, [plate(), plate()])
    assert moment is not None
    assert moment.moves.tolist() == [False, True]
    np.testing.assert_array_equal(moment.world_T_object[0, 0], moment.world_T_object[1, 0])
    np.testing.assert_array_equal(moment.world_T_object[1, 1], made.world_T_object[60, 1])


def test_no_pair_shows_what_neither_moves_nor_stands_still() -> None:
    models = [plate(), plate()]
    assert pick(recording([0.004, 0.05]), models) is None
    assert pick(recording([0.05, 0.05]), models, (1, 1)) is None  # too many move
    assert pick(recording([0.0, 0.0]), models) is None  # none does
    deep = replace(recording([0.0, 0.05]), depth=np.full(61, 0.01))
    assert pick(deep, models) is None


def test_a_turn_that_cannot_be_seen_is_no_motion_to_be_found() -> None:
    """A quarter turn of a square plate about its axis."""
    made = recording([], [np.pi / 2])
    assert pick(made, [plate((SymmetryAxis((0.0, 0.0, 1.0), 4),))]) is None
    moment = pick(made, [plate()])
    assert moment is not None
    assert moment.moves.tolist() == [True]


def test_without_movers_one_frame_is_taken_twice() -> None:
    moment = pick(recording([0.5]), [plate()], (0, 0))
    assert moment is not None
    assert not moment.moves.any()
    np.testing.assert_array_equal(*moment.world_T_object)


def test_box_meshes_are_closed_and_look_outwards() -> None:
    vertices, faces, uv = box_mesh((0.3, 0.2, 0.1))
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    assert mesh.is_watertight
    assert math.isclose(mesh.volume, 8 * 0.3 * 0.2 * 0.1)
    # Textures are not stretched: metres on the surface are metres of the texture.
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    ua, ub, uc = (np.c_[uv, np.zeros(len(uv))][faces[:, k]] for k in range(3))
    np.testing.assert_allclose(np.linalg.norm(b - a, axis=1), np.linalg.norm(ub - ua, axis=1))
    np.testing.assert_allclose(np.linalg.norm(c - a, axis=1), np.linalg.norm(uc - ua, axis=1))


def test_slabs_block_the_view() -> None:
    wall = Slab((1.0, 0.0, 0.5), 0.0, (0.02, 1.0, 0.5), LOOK)
    target = np.zeros(3)
    assert is_open((wall,), np.array([0.5, 0, 0.5]), target)
    assert not is_open((wall,), np.array([1.5, 0, 0.5]), target)
    assert not is_open((wall,), np.array([0.96, 0, 0.5]), target)  # too near
    assert is_open((wall,), np.array([1.5, 0, 3.0]), target)  # over it
    turned = replace(wall, turn=math.pi / 2)
    assert is_open((turned,), np.array([1.5, 0.5, 0.5]), np.array([0.0, 0.5, 0.0]))


def test_surroundings_bear_the_objects_at_height_zero() -> None:
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(60):
        around = draw_surroundings(rng, 0.2)
        groups = [group for group, _ in around.slabs]
        kinds.update(groups)
        assert ("table" in groups) == (around.floor < 0)
        assert ("wall" in groups) == around.walls
        for group, slab in around.slabs:
            if group == "table":
                assert math.isclose(slab.center[2] + slab.half[2], 0, abs_tol=1e-12)
                assert min(slab.half[:2]) > 0.2
    assert kinds == {"table", "wall", "bin"}


def test_scenes_are_plain_data_drawn_from_one_seed() -> None:
    def draw(seed: int, *, motionless: bool = False):  # type: ignore[no-untyped-def]
        rng = np.random.default_rng(seed)
        return draw_wild_scene(rng, ProceduralLibrary(), "val", SMALL, motionless=motionless)

    one, same = draw(3), draw(3)
    assert one.scene == same.scene
    assert one.actions == same.actions
    assert Scene.from_dict(json.loads(json.dumps(one.scene.to_dict()))) == one.scene
    assert draw(3, motionless=True).actions == ()
    for seed in range(20):
        wild = draw(seed)
        places = [one.object for one in wild.actions]
        assert len(set(places)) == len(places) <= 8
        assert all(0 <= place < len(wild.scene.objects) for place in places)


class FakeLibrary:
    """Three meshes, one a split."""

    def refs(self, split: str) -> Sequence[ModelRef]:
        return [ModelRef("mesh", split)]

    def load(self, ref: ModelRef) -> ObjectModel:
        return replace(plate(), name=ref.name)


def test_meshes_are_mixed_in_by_their_share() -> None:
    mixed = MixedLibrary(FakeLibrary(), ProceduralLibrary(), 0.3, every=False)
    refs = mixed.refs("val")
    picked = [refs[int(k)] for k in np.random.default_rng(0).integers(len(refs), size=2000)]
    meshes = [ref for ref in picked if ref.category == "mesh"]
    assert 0.26 < len(meshes) / len(picked) < 0.34
    assert set(meshes) == {ModelRef("mesh", "val")}
    assert mixed.load(meshes[0]).name == "val"
    assert mixed.load(refs[99]).category != "mesh"
    everything = MixedLibrary(FakeLibrary(), ProceduralLibrary(), 1.0, every=True).refs("test")
    assert [ref.name for ref in everything] == ["train", "val", "test"]


@pytest.fixture(scope="module")
def rows() -> list[PairRow]:
    make = ClutterScenes(0, "val", replace(SMALL, motionless=0.4, moving_camera=0.5), samples=1)()
    made = [row for scene in range(8) for row in make(Task("pairs", scene)).rows]
    return [PairRow.from_dict(row) for row in made]


def test_rows_hold_together_and_come_in_all_kinds(rows: list[PairRow]) -> None:
    assert [contradictions(row) for row in rows] == [[]] * len(rows)
    movers = [len(moving_labels(row)) for row in rows]
    cameras = [not np.array_equal(row.camera_motion, np.eye(4)) for row in rows]
    assert 0 in movers
    assert max(movers) > 0
    assert set(cameras) == {False, True}


def test_pixels_go_where_the_row_says_the_world_s_too(rows: list[PairRow]) -> None:
    for row in rows:
        assert row.camera_motion is not None
        errors = warp_errors(row, raw=True)
        assert np.median(np.abs(errors.depth)) < 0.001
        # The world, by its own: flat surfaces seen in both frames, compared at the nearest pixel.
        points = geometry.back_project(row.curr.depth, row.curr.camera)[row.curr_labels == 0].astype(np.float64)
        points = points[np.isfinite(points).all(-1)]
        before = geometry.transform(row.camera_motion, points)
        column, line = np.rint(geometry.project(before, row.prev.camera)).astype(int).T
        height, width = row.prev.depth.shape
        inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        seen = row.prev.depth[line[inside], column[inside]]
        world = row.prev_labels[line[inside], column[inside]] == 0
        difference = np.abs(seen - before[inside, 2])[world & (seen > 0)]
        if len(difference) > 500:
            assert np.median(difference) < 0.01


def test_what_nothing_touches_looks_the_same_twice_before_a_still_camera(rows: list[PairRow]) -> None:
    still = [row for row in rows if np.array_equal(row.camera_motion, np.eye(4)) and not moving_labels(row)]
    assert still
    for row in still:
        np.testing.assert_array_equal(row.prev.color, row.curr.color)
        np.testing.assert_array_equal(row.prev.depth, row.curr.depth)


def test_the_same_seed_gives_the_same_row(rows: list[PairRow]) -> None:
    make = ClutterScenes(0, "val", replace(SMALL, motionless=0.4, moving_camera=0.5), samples=1)()
    again = PairRow.from_dict(make(Task("pairs", 5)).rows[0])
    np.testing.assert_array_equal(again.curr.color, rows[5].curr.color)
    np.testing.assert_array_equal(again.curr.depth, rows[5].curr.depth)


def test_settings_and_sequences_that_cannot_be() -> None:
    with pytest.raises(DatasetError, match="movers and gap"):
        WildSettings(gap=(0, 3))
    with pytest.raises(DatasetError, match="shares"):
        WildSettings(motionless=1.5)
    with pytest.raises(DatasetError, match="split"):
        ClutterScenes(0, "holdout")
    with pytest.raises(DatasetError, match="sequences"):
        ClutterScenes(0, "val", SMALL)()(Task("sequences", 0))
