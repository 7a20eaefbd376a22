"""A run in the viewer has the ids, poses and masks that the run wrote."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from objectflow.cli import main
from objectflow.cli.run_folder import open_run_source, read_known, read_tracks, run_pairs
from objectflow.motion import SceneMotion
from objectflow.tracking.trajectory_files import TRACKS
from objectflow.typing import LabelImage
from objectflow.view.run_frames import RunFrames, UnfinishedRunFrames
from objectflow.view.viewer_frames import NO_TRACK

PAIR = Path(str(resources.files("objectflow"))) / "demo" / "pair"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo there, back and there again, whose tracks are then renumbered in the files of the run."""
    folder = tmp_path_factory.mktemp("run")
    source = folder / "clip"
    for kind, suffix in (("color", "jpg"), ("depth", "png")):
        (source / kind).mkdir(parents=True)
        for index in range(3):
            shutil.copy(PAIR / f"{kind}{index % 2}.{suffix}", source / kind / f"{index}.{suffix}")
    shutil.copy(PAIR / "camera.json", source)
    out = folder / "out"
    command = ["run", str(source), "--method", "consensus", "--camera", "static", "--no-pictures"]
    assert main([*command, "--out", str(out)]) == 0
    content = json.loads((out / TRACKS).read_text())
    for track in content["tracks"]:
        track["id"] += 40  # Ids that a tracker would not give.
    (out / TRACKS).write_text(json.dumps(content))
    return out


def frames_of(result: Path) -> RunFrames:
    return RunFrames(
        open_run_source(result, None, "--frames"), read_tracks(result), lambda pair: 0 * read_known(pair), {}
    )


def test_ids_and_poses_are_those_of_the_run(result: Path) -> None:
    frames = frames_of(result)
    tracks = {track.id: track for track in read_tracks(result)}
    assert len(tracks) >= 3
    for prev, curr, folder in run_pairs(result):
        motion = SceneMotion.load(folder)
        before, after = frames.read(folder, prev, curr)
        assert after.ids is not None
        assert [obj.id for obj in after.objects] == sorted(obj.id for obj in after.objects)
        for earlier, obj in zip(before.objects, after.objects, strict=True):
            track = tracks[obj.id]
            assert obj.name == f"object {obj.id}"
            if float(curr) not in track.times:
                assert obj.path is None
                continue
            k = track.times.index(float(curr))
            np.testing.assert_array_equal(obj.world_T_object, track.world_T_object[k])
            np.testing.assert_array_equal(earlier.world_T_object, track.world_T_object[max(k - 1, 0)])
            if track.labels[k]:
                np.testing.assert_array_equal(after.ids == obj.id, motion.labels == track.labels[k])
                assert obj.path is not None
        assert set(np.unique(after.ids)) <= {0, NO_TRACK, *tracks}


def test_an_object_is_shown_from_its_first_pose_on(result: Path) -> None:
    tracks = read_tracks(result)
    late = replace(
        tracks[0],
        times=[1.0, 2.0],
        world_T_object=[tracks[0].world_T_object[0], tracks[0].world_T_object[-1]],
        labels=[0, tracks[0].labels[-1]],
        scores=[1.0, 1.0],
    )
    frames = RunFrames(open_run_source(result, None, "--frames"), [late], read_known, {})
    (_, first), (_, second) = (frames.read(folder, prev, curr) for prev, curr, folder in run_pairs(result))
    np.testing.assert_array_equal(first.objects[0].world_T_object, late.world_T_object[0])
    assert first.objects[0].path is None
    np.testing.assert_array_equal(second.objects[0].world_T_object, late.world_T_object[1])


def test_an_object_that_a_frame_does_not_show_is_left_out(result: Path) -> None:
    (_, _, first), (prev, curr, second) = run_pairs(result)
    track = read_tracks(result)[0]
    early = replace(
        track,
        times=track.times[:2],
        world_T_object=track.world_T_object[:2],
        labels=track.labels[:2],
        scores=track.scores[:2],
    )
    for seen in (False, True):

        def known(folder: Path, seen: bool = seen) -> LabelImage:
            image = 0 * read_known(folder)
            image[:5, :5] = early.id if seen else 0
            return image

        frames = RunFrames(open_run_source(result, None, "--frames"), [early], known, {})
        frames.skip(first, 0, prev)
        _, after = frames.read(second, prev, curr)
        assert [obj.id for obj in after.objects] == ([early.id] if seen else [])
        assert all(obj.path is None for obj in after.objects)


def test_one_pair_is_shown_in_the_world_of_its_run(result: Path) -> None:
    first, second = run_pairs(result)
    whole, alone = frames_of(result), frames_of(result)
    whole.read(first[2], first[0], first[1])
    expected = whole.read(second[2], second[0], second[1])
    alone.skip(first[2], first[0], first[1])
    found = alone.read(second[2], second[0], second[1])
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.world_T_camera, b.world_T_camera)
        assert [obj.id for obj in a.objects] == [obj.id for obj in b.objects]
        for one, other in zip(a.objects, b.objects, strict=True):
            np.testing.assert_array_equal(one.world_T_object, other.world_T_object)


def test_the_masks_of_known_objects_are_shown_at_rest(result: Path) -> None:
    prev, curr, folder = run_pairs(result)[0]
    shape = SceneMotion.load(folder).labels.shape
    known = np.zeros(shape, np.int32)
    known[:5, :5] = 41
    source = open_run_source(result, None, "--frames")
    _, after = RunFrames(source, read_tracks(result), lambda pair: known, {}).read(folder, prev, curr)
    assert after.ids is not None
    assert (after.ids[:5, :5] == 41).all()


def test_an_unfinished_run_is_shown_by_a_tracker_of_its_own(result: Path) -> None:
    frames = UnfinishedRunFrames(open_run_source(result, None, "--frames"))
    shown = [frames.read(folder, prev, curr)[1] for prev, curr, folder in run_pairs(result)]
    assert [obj.id for obj in shown[0].objects] == list(range(1, len(shown[0].objects) + 1))
    # Objects that moved there and back keep their ids.
    assert {obj.id for obj in shown[0].objects} <= {obj.id for obj in shown[1].objects}
    assert all((frame.world_T_camera == np.eye(4)).all() for frame in shown)
