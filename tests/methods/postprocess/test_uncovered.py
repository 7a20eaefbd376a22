"""Background that a mover uncovered, and shadows: neither is a mover."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import objectflow
from helpers.flat_scenes import CAMERA, WALL, Card, draw, object_of, texture
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.pipeline import postprocess
from objectflow.methods.postprocess.settings import PostprocessSettings, StaticTestSettings
from objectflow.methods.postprocess.static_test import reject_static
from objectflow.methods.postprocess.uncovered import RestingCosts
from objectflow.typing import BoolMask, LabelImage, UInt8Array

DEFAULTS = PostprocessSettings()
PLAIN = np.full((CAMERA.height, CAMERA.width, 3), 170, np.uint8)
BEFORE, CARD = Card(1, 30, 35, 40, 50, 0.8), Card(1, 90, 35, 40, 50, 0.8)
PIECE = Card(0, 32, 40, 20, 40, WALL).mask
"""Wall that the card hid."""
FAR = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.3])
"""A motion without support: from behind the wall."""


def uncovered(wall: UInt8Array) -> tuple[FramePair, LabelImage, Objects]:
    """A card that moved, and a piece of the wall that it uncovered, said to move."""
    prev, curr = draw(BEFORE, wall=wall), draw(CARD, wall=wall)
    labels = CARD.mask.astype(np.int32) + 2 * PIECE.astype(np.int32)
    mover = object_of(1, CARD.mask, curr, CARD.motion(60))
    return FramePair(prev, curr), labels, (mover, object_of(2, PIECE, curr, FAR, score=0.9))


@pytest.mark.parametrize("known", [True, False], ids=["beside its mover", "alone"])
def test_uncovered_background_beside_a_mover_is_static(known: bool) -> None:
    """Where standing still explains uncovered background, as with a low cost of it; else the network decides."""
    settings = dataclasses.replace(DEFAULTS, static_test=StaticTestSettings(uncovered_cost=0.6))
    pair, labels, objects = uncovered(PLAIN)
    chosen = objects if known else objects[1:]
    found = {obj.id: obj for obj in reject_static(pair, labels, chosen, settings)[1]}
    assert found[2].moving is not known
    if known:
        assert found[1].moving
        np.testing.assert_array_equal(found[2].prev_T_curr, np.eye(4))


@pytest.mark.parametrize("plain", [True, False])
def test_the_cost_of_uncovered_background_depends_on_its_texture(plain: bool) -> None:
    wall = PLAIN if plain else texture(7, CAMERA.height, CAMERA.width)
    pair, labels, objects = uncovered(wall)
    likelihood = PairLikelihood(pair, DEFAULTS.likelihood)
    cost = RestingCosts(likelihood, labels, objects, DEFAULTS.static_test).of(2)
    alone = RestingCosts(likelihood, labels, objects[1:], DEFAULTS.static_test).of(2)
    np.testing.assert_allclose(alone, DEFAULTS.likelihood.hidden, atol=1e-5)
    if plain:
        np.testing.assert_allclose(cost, DEFAULTS.static_test.uncovered_cost, atol=0.02)
    else:
        assert cost.mean() > 0.9 * alone.mean()


SHADOW = Card(0, 60, 40, 40, 35, WALL).mask


def shaded(frame: RgbdFrame, mask: BoolMask) -> RgbdFrame:
    """The frame with half of the light in a region."""
    color = frame.color.copy()
    color[mask] //= 2
    return dataclasses.replace(frame, color=color)


def noisy_table(seed: int) -> RgbdFrame:
    """A plain wall with a little noise of colour and depth."""
    rng = np.random.default_rng(seed)
    color = np.clip(PLAIN + rng.normal(0, 1.5, PLAIN.shape), 0, 255).astype(np.uint8)
    depth = WALL + 0.001 * rng.standard_normal(PLAIN.shape[:2])
    return RgbdFrame(color, depth.astype(np.float32), CAMERA)


@pytest.mark.parametrize("appears", [True, False], ids=["appears", "disappears"])
def test_a_shadow_on_a_plain_table_is_no_mover(appears: bool) -> None:
    frames = [noisy_table(0), noisy_table(1)]
    frames[appears] = shaded(frames[appears], SHADOW)
    assert objectflow.load("consensus", camera="static")(*frames).moving == ()


def test_a_shadow_that_a_network_masks_is_no_mover() -> None:
    """After all default steps, with a motion along the table."""
    frames = noisy_table(0), shaded(noisy_table(1), SHADOW)
    slide = geometry.make_transform(np.eye(3), [0.15, 0.0, 0.0])
    obj = object_of(1, SHADOW, frames[1], slide, score=0.9)
    _, found = postprocess(FramePair(*frames), SHADOW.astype(np.int32), (obj,), DEFAULTS)
    assert not any(one.moving for one in found)


@pytest.mark.parametrize("beside", [True, False], ids=["beside a mover", "alone"])
def test_a_change_of_colour_alone_beside_a_larger_mover_is_its_shadow(beside: bool) -> None:
    """The shadow went with the card, and a motion along the plain table explains the bright table as well."""
    before, after = Card(1, 100, 30, 50, 60, 0.8), Card(1, 102, 30, 50, 60, 0.8)
    prev, curr = shaded(draw(before, wall=PLAIN), SHADOW), draw(after, wall=PLAIN)
    labels = after.mask.astype(np.int32) + 2 * (SHADOW & ~after.mask).astype(np.int32)
    slide = geometry.make_transform(np.eye(3), [-0.3, 0.0, 0.0])
    mover = object_of(1, after.mask, curr, after.motion(2))
    shadow = object_of(2, SHADOW & ~after.mask, curr, slide)
    chosen = (mover, shadow) if beside else (shadow,)
    found = {obj.id: obj for obj in reject_static(FramePair(prev, curr), labels, chosen, DEFAULTS)[1]}
    assert found[2].moving is not beside
