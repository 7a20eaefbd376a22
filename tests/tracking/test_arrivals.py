"""Objects whose motion is unsure: known from the frame on in which they are certainly somewhere new."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.plate_scenes import CAMERA, Place, PlateScene, iou, play_changed
from objectflow import SequenceEstimator
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import SettingsError
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.motion import SceneMotion
from objectflow.tracking import SequenceStep
from objectflow.tracking.arrivals import Arrivals, ArrivalSettings
from objectflow.tracking.known_settings import KnownSettings
from objectflow.typing import LabelImage

NEAR: Place = (-0.2, 0.0, 1.0)
FAR: Place = (0.2, 0.1, 1.3)


def arrivals(before: dict[int, Place], after: dict[int, Place], **settings: float) -> tuple[Arrivals, LabelImage]:
    """Those between two frames of plates, and the labels of the second."""
    scene = PlateScene()
    pair = FramePair(scene.frame(0, before), scene.frame(1, after))
    found = Arrivals(pair, np.eye(4), STRUCTURED_LIGHT, replace(ArrivalSettings(), **settings))
    return found, scene.labels[1]


def test_a_plate_that_is_put_before_the_wall_arrives_and_what_it_hides_does_not_count() -> None:
    found, labels = arrivals({}, {1: NEAR})
    assert iou(found.new, labels == 1) > 0.97
    assert found.contains(labels, 1)
    assert not found.contains(np.where(labels == 1, 0, 2), 2)


def test_what_a_plate_uncovers_may_have_stood_still() -> None:
    found, labels = arrivals({1: NEAR}, {})
    assert not found.new.any()
    # A plate at rest that was hidden, and the wall: neither is known to have moved.
    found, labels = arrivals({1: (-0.15, 0.0, 0.7), 3: NEAR}, {3: NEAR})
    assert not found.contains(labels, 3)


def test_a_change_of_colour_and_what_comes_into_view_are_no_arrivals() -> None:
    found, _ = arrivals({1: NEAR}, {4: NEAR})  # another texture at the same depth
    assert not found.new.any()
    scene = PlateScene()
    pair = FramePair(scene.frame(0, {}), scene.frame(1, {1: (-0.45, 0.0, 1.0)}))
    turned = np.eye(4)
    turned[0, 3] = -0.4  # the camera moved: the previous frame ends to the right of the plate
    found = Arrivals(pair, turned, STRUCTURED_LIGHT, ArrivalSettings())
    assert not found.new[scene.labels[1] == 1].any()


@pytest.mark.parametrize(("shift", "arrives"), [(0.04, False), (0.12, True)])
def test_a_share_of_the_mask_must_be_new(shift: float, arrives: bool) -> None:
    """A plate of 24 cm slides sideways: a sixth or half of it is before what the previous frame saw of the wall."""
    x, y, z = NEAR
    found, labels = arrivals({1: NEAR}, {1: (x + shift, y, z)})
    share = float(found.new[labels == 1].mean())
    assert share == pytest.approx(shift / 0.24, abs=0.03)
    assert found.contains(labels, 1) is arrives
    assert arrivals({1: NEAR}, {1: (x + shift, y, z)}, min_share=0.9)[0].contains(labels, 1) is False


def played(
    places: list[dict[int, Place]], unsure: int, settings: KnownSettings | None = None
) -> tuple[PlateScene, SequenceEstimator, list[SequenceStep]]:
    """A sequence in which the method has no idea of the motion into frame `unsure`: a wrong one, and a low score."""

    def change(number: int, found: SceneMotion) -> SceneMotion:
        if number != unsure:
            return found
        wrong = np.eye(4)
        wrong[:3, 3] = 0.3, -0.2, 0.1
        return replace(found, objects=tuple(replace(obj, score=0.05, prev_T_curr=wrong) for obj in found.objects))

    return play_changed(places, change, settings=settings)


def test_a_track_begins_where_an_object_arrived_by_an_unknown_motion() -> None:
    places: list[dict[int, Place]] = [{1: NEAR}, {1: FAR}, *({1: (0.2 + 0.03 * k, 0.1, 1.3)} for k in (1, 2, 2))]
    scene, sequence, steps = played(places, unsure=1)
    (track,) = sequence.tracks
    assert [step.tracks for step in steps] == [{1: track.id}] * 3 + [{}]
    assert track.gaps == [1]
    assert track.times[0] == 1  # where it was before is not known
    assert all(iou(step.known == track.id, scene.labels[n] == 1) > 0.85 for n, step in enumerate(steps, start=1))
    moved = track.world_T_object[-1][:3, 3] - track.world_T_object[0][:3, 3]
    np.testing.assert_allclose(moved, [0.06, 0, 0], atol=0.004)
    assert track.confidence == pytest.approx((0.05 + 0.9 + 0.9) / 4)


def test_an_object_of_low_score_that_may_have_stood_still_stays_unknown() -> None:
    x, y, z = NEAR
    places: list[dict[int, Place]] = [{1: NEAR}, {1: (x + 0.04, y, z)}]
    _, sequence, steps = played(places, unsure=1)
    assert not sequence.tracks
    assert not steps[0].known.any()
    settings = KnownSettings(arrival=ArrivalSettings(min_share=0.1))
    assert len(played(places, unsure=1, settings=settings)[1].tracks) == 1


def test_bad_settings_are_refused() -> None:
    with pytest.raises(SettingsError, match="min_share"):
        ArrivalSettings(min_share=1.5)
    assert CAMERA.width < ArrivalSettings().likelihood.width  # small frames are compared as they are
