"""Augmentation of rendered scenes, checked by warping them with their own motions, and noise of sensors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from analytic import AnalyticPair, make_scene
from helpers.object_tables import object_table
from objectflow import geometry
from objectflow.dataset import transforms
from objectflow.dataset.augment import AugmentSettings, augment, network_inputs, normalize_depth
from objectflow.dataset.batches import Batch
from objectflow.dataset.schema import PairObject, PairRow
from objectflow.dataset.targets import ObjectTable, make_targets
from objectflow.dataset.warp_check import warp_errors
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.networks.sceneflownet.outputs import scene_flow

SEEDS = (3, 5, 8)
EVERY = torch.ones(len(SEEDS), dtype=torch.bool)


def objects_of(pair: AnalyticPair) -> list[PairObject]:
    entries = []
    for label, center in pair.centers.items():
        motion = pair.prev_T_curr[label]
        vector = geometry.so3_log(motion[:3, :3])
        shift = geometry.transform(motion, center[None])[0] - center
        seen = bool((pair.labels == label).any() and (pair.prev_labels == label).any())
        entries.append(PairObject(label, "box", "box", center, shift, vector, vector, (), np.eye(4), np.eye(4), seen))
    return entries


@pytest.fixture(scope="module")
def batch() -> Batch:
    pairs = [make_scene(seed, objects=(3, 5), width=160, height=120) for seed in SEEDS]

    def stack(values: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.stack(values))

    camera = pairs[0].curr.camera
    return Batch(
        keys=tuple(str(seed) for seed in SEEDS),
        prev_color=stack([pair.prev.color for pair in pairs]).permute(0, 3, 1, 2),
        curr_color=stack([pair.curr.color for pair in pairs]).permute(0, 3, 1, 2),
        prev_depth=stack([pair.prev.depth for pair in pairs]),
        curr_depth=stack([pair.curr.depth for pair in pairs]),
        prev_labels=stack([pair.prev_labels for pair in pairs]),
        curr_labels=stack([pair.labels for pair in pairs]),
        intrinsics=torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy]).expand(len(SEEDS), 4),
        table=object_table([objects_of(pair) for pair in pairs]),
    )


def rows_of(batch: Batch) -> list[PairRow]:
    """The rows that `warp_errors` takes: independent NumPy code."""
    rows = []
    height, width = batch.curr_depth.shape[1:]
    for b, key in enumerate(batch.keys):
        camera = Camera(width, height, *batch.intrinsics[b].double().tolist())
        frames = [
            RgbdFrame(
                color=getattr(batch, f"{when}_color")[b].permute(1, 2, 0).contiguous().numpy(),
                depth=getattr(batch, f"{when}_depth")[b].numpy(),
                camera=camera,
            )
            for when in ("prev", "curr")
        ]
        table = batch.table
        entries = []
        for k in range(table.label.shape[1]):
            if table.label[b, k] > 0:
                X, T, Q = (getattr(table, n)[b, k].double().numpy() for n in ("center", "translation", "rotation"))
                seen = bool(table.in_both[b, k])
                entries.append(PairObject(int(table.label[b, k]), "", "", X, T, Q, Q, (), np.eye(4), np.eye(4), seen))
        labels = batch.prev_labels[b].numpy(), batch.curr_labels[b].numpy()
        rows.append(PairRow(key, key, frames[0], labels[0], frames[1], labels[1], tuple(entries)))
    return rows


def quality(batch: Batch) -> tuple[float, float, float, int]:
    """Median and 95 % depth error in metres, median colour error, pixels compared."""
    errors = [warp_errors(row, raw=True) for row in rows_of(batch)]
    depth, color = np.concatenate([e.depth for e in errors]), np.concatenate([e.color for e in errors])
    return (
        float(np.median(np.abs(depth))),
        float(np.quantile(np.abs(depth), 0.95)),
        float(np.median(color)),
        len(depth),
    )


def variation(name: str, batch: Batch) -> Batch:
    if name == "flip":
        return transforms.flip(batch, EVERY)
    if name == "swap":
        return transforms.swap(batch, EVERY)
    if name.startswith("turn"):
        return transforms.turn(batch, int(name[4:]))
    if name == "rescale":
        return transforms.rescale(batch, torch.tensor([0.5, 1.0, 1.5]))
    if name == "crop":
        place = torch.tensor([[0.2, 0.9], [0.5, 0.5], [1.0, 0.0]])
        return transforms.crop(batch, torch.tensor([1.3, 1.17, 1.05]), place)
    settings = AugmentSettings(flip=1, turn=1, swap=1, zoom=1.3, brightness=0, contrast=0, saturation=0, hue=0)
    return augment(batch, settings, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", ["flip", "turn1", "turn2", "turn3", "swap", "crop", "rescale", "all"])
def test_motions_still_map_current_points_to_previous_ones(batch: Batch, name: str) -> None:
    before, after = quality(batch), quality(variation(name, batch))
    assert before[0] < 1e-5  # the scenes are exact, and planes stay exact
    assert after[0] < 2e-5
    assert after[1] < 2 * before[1]  # curved surfaces are extrapolated along their tangent
    # Enlarged images differ less between neighbours, and fewer of their pixels lie next to an edge.
    assert after[2] < 1.2 * before[2]
    assert after[3] > 0.8 * before[3]


def test_a_wrong_sign_is_detected(batch: Batch) -> None:
    """The check of the test above is sensitive."""
    flipped = transforms.flip(batch, EVERY)
    wrong = dataclasses.replace(flipped.table, rotation=-flipped.table.rotation)
    assert quality(dataclasses.replace(flipped, table=wrong))[1] > 5e-3
    cropped = variation("crop", batch)
    shifted = cropped.intrinsics + torch.tensor([0.0, 0.0, 0.5, 0.0])
    assert quality(dataclasses.replace(cropped, intrinsics=shifted))[0] > 1e-4


@pytest.mark.parametrize("name", ["flip", "swap"])
def test_applying_a_transform_twice_restores_the_batch(batch: Batch, name: str) -> None:
    batch = with_camera_motion(batch)
    twice = variation(name, variation(name, batch))
    for field in dataclasses.fields(Batch):
        if field.name not in ("keys", "table"):
            torch.testing.assert_close(getattr(twice, field.name), getattr(batch, field.name))
    for field in dataclasses.fields(ObjectTable):
        torch.testing.assert_close(getattr(twice.table, field.name), getattr(batch.table, field.name))


def test_four_quarters_are_a_whole_turn(batch: Batch) -> None:
    batch = with_camera_motion(batch)
    quarter = transforms.turn(batch, 1)
    assert quarter.curr_depth.shape == (len(batch), 160, 120)
    assert quarter.prev_color.shape == (len(batch), 3, 160, 120)
    again = transforms.turn(transforms.turn(quarter, 2), 1)
    for field in dataclasses.fields(Batch):
        if field.name not in ("keys", "table"):
            torch.testing.assert_close(getattr(again, field.name), getattr(batch, field.name))
    for field in dataclasses.fields(ObjectTable):
        torch.testing.assert_close(getattr(again.table, field.name), getattr(batch.table, field.name))


def test_median_depth_is_normalised_and_a_scale_is_drawn_around_it(batch: Batch) -> None:
    settings = AugmentSettings(scale=(0.7, 1.4))
    seen = network_inputs(batch, settings, None)
    near, inputs, factor = normalize_depth(batch, seen, 0.75, settings, None)
    torch.testing.assert_close(inputs.curr_points[:, 2].flatten(1).nanmedian(1).values, torch.full((3,), 0.75))
    torch.testing.assert_close(near.table.translation, factor[:, None, None] * batch.table.translation)
    far, other, half = normalize_depth(
        transforms.rescale(batch, torch.full((3,), 5.0)), seen._replace(curr_points=5 * seen.curr_points), 0.75,
        settings, None,
    )  # fmt: skip
    torch.testing.assert_close(5 * half, factor)
    torch.testing.assert_close(far.curr_depth, near.curr_depth)
    torch.testing.assert_close(other.curr_points, inputs.curr_points, equal_nan=True)
    _, _, drawn = normalize_depth(batch, seen, 0.75, settings, torch.Generator().manual_seed(0))
    assert bool(((drawn / factor > 0.7) & (drawn / factor < 1.4)).all())
    assert len((drawn / factor).unique()) == 3
    same, kept, one = normalize_depth(batch, seen, 0.0, settings, torch.Generator())
    assert same is batch
    assert kept is seen
    assert one.tolist() == [1, 1, 1]


def test_only_the_selected_pairs_change(batch: Batch) -> None:
    which = torch.tensor([False, True, False])
    for change in (transforms.flip, transforms.swap):
        changed = change(batch, which)
        assert torch.equal(changed.prev_depth[::2], batch.prev_depth[::2])
        assert torch.equal(changed.table.center[::2], batch.table.center[::2])
        assert not torch.equal(changed.prev_depth[1], batch.prev_depth[1])


def test_a_crop_mixes_no_depths_and_removes_objects_outside_it(batch: Batch) -> None:
    """Two surfaces in front of a third: no depth between them appears. Objects outside the crop leave the table."""
    depth = torch.full((1, 40, 60), 0.9)
    labels = torch.zeros(1, 40, 60, dtype=torch.int32)
    depth[:, 10:20, 10:25], labels[:, 10:20, 10:25] = 0.5, 1
    depth[:, 30:38, 50:58], labels[:, 30:38, 50:58] = 0.6, 2
    depth[:, 0, :] = 0
    table = ObjectTable(torch.tensor([[1, 2]]), *torch.rand(3, 1, 2, 3), torch.ones(1, 2, dtype=torch.bool))
    color = torch.zeros(1, 3, 40, 60, dtype=torch.uint8)
    scene = Batch(("a",), color, color, depth, depth, labels, labels * (labels < 2), torch.ones(1, 4), table)
    part = transforms.crop(scene, torch.tensor([1.37]), torch.tensor([[1.0, 1.0]]))
    values = torch.tensor([0.0, 0.5, 0.6, 0.9])
    assert float((part.prev_depth[..., None] - values).abs().amin(-1).max()) < 1e-6
    fronts = (part.prev_depth < 0.7) & (part.prev_depth > 0)
    assert torch.equal(fronts, part.prev_labels > 0)
    assert part.table.label.tolist() == [[1, 2]]
    assert part.table.in_both.tolist() == [[True, False]]
    away = transforms.crop(scene, torch.tensor([2.0]), torch.tensor([[0.0, 0.0]]))
    assert away.table.label.tolist() == [[1, 0]]
    make_targets(away.table, away.curr_labels, torch.ones(1, 3, 40, 60))


def test_equal_generators_draw_equal_batches(batch: Batch) -> None:
    settings = AugmentSettings()

    def draw(seed: int) -> tuple[torch.Tensor, ...]:
        generator = torch.Generator().manual_seed(seed)
        return tuple(network_inputs(augment(batch, settings, generator), settings, generator))

    first, again, other = draw(1), draw(1), draw(2)
    assert all(torch.equal(a.nan_to_num(-1), b.nan_to_num(-1)) for a, b in zip(first, again, strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(first, other, strict=True))


def test_the_settings_nothing_change_no_batch(batch: Batch) -> None:
    settings = AugmentSettings.nothing()
    same = augment(batch, settings, torch.Generator())
    assert all(getattr(same, field.name) is getattr(batch, field.name) for field in dataclasses.fields(Batch))
    inputs, exact = network_inputs(batch, settings, torch.Generator()), network_inputs(batch, AugmentSettings(), None)
    for a, b in zip(inputs, exact, strict=True):
        torch.testing.assert_close(a, b, equal_nan=True, rtol=0, atol=0)


def test_inputs_without_noise_are_the_frames(batch: Batch) -> None:
    inputs = network_inputs(batch, AugmentSettings(), None)
    for b, row in enumerate(rows_of(batch)):
        for points, frame in ((inputs.prev_points, row.prev), (inputs.curr_points, row.curr)):
            expected = geometry.back_project(frame.depth, frame.camera)
            expected[frame.depth <= 0] = np.nan
            np.testing.assert_allclose(points[b].permute(1, 2, 0), expected, atol=1e-6)
        np.testing.assert_allclose(inputs.prev_color[b].permute(1, 2, 0), row.prev.color / 255, atol=1e-6)
        np.testing.assert_allclose(inputs.curr_color[b].permute(1, 2, 0), row.curr.color / 255, atol=1e-6)


def test_noise_reaches_inputs_and_not_targets(batch: Batch) -> None:
    settings = AugmentSettings(depth_sensor=1, color_sensor=1, sensors=2)
    inputs = network_inputs(batch, settings, torch.Generator().manual_seed(0))
    exact = network_inputs(batch, settings, None)
    torch.testing.assert_close(inputs.exact_points, exact.curr_points, equal_nan=True, rtol=0, atol=0)
    lost = inputs.curr_points.isnan() & exact.curr_points.isfinite()
    assert 0.001 < float(lost.float().mean()) < 0.6
    off = (inputs.curr_points - exact.curr_points)[:, 2]
    for b in range(len(batch)):
        known = off[b].isfinite()
        assert 1e-5 < float(off[b][known].abs().median()) < 0.02
    targets = make_targets(batch.table, batch.curr_labels, inputs.exact_points)
    assert bool((targets.mask & lost[:, 0]).any())  # pixels without measured depth keep their targets
    flow = scene_flow(targets.rotation, targets.translation, targets.center, exact.curr_points)
    measured = targets.mask & exact.curr_points[:, 2].isfinite()
    torch.testing.assert_close(
        flow.transpose(0, 1)[:, measured], targets.flow.transpose(0, 1)[:, measured], atol=1e-6, rtol=1e-4
    )


def test_both_frames_share_their_colour_change(batch: Batch) -> None:
    settings = dataclasses.replace(AugmentSettings.nothing(), brightness=0.4, contrast=0.3, saturation=0.5, hue=0.5)
    still = dataclasses.replace(batch, prev_color=batch.curr_color)
    alike = augment(still, settings, torch.Generator().manual_seed(0))
    assert torch.equal(alike.prev_color, alike.curr_color)
    assert not torch.equal(alike.curr_color, batch.curr_color)
    own = augment(still, dataclasses.replace(settings, frame_jitter=0.2), torch.Generator().manual_seed(0))
    apart = (own.prev_color.float() - own.curr_color.float()).abs().mean()
    assert 0.1 < float(apart) < float((alike.curr_color.float() - batch.curr_color.float()).abs().mean())


def test_brightness_contrast_saturation_and_hue() -> None:
    color = torch.full((1, 3, 4, 4), 100, dtype=torch.uint8)
    color[:, 0, :, 2:] = 160
    empty = torch.zeros(1, 4, 4)
    table = object_table([[]])
    one = Batch(("a",), color, color, empty, empty, empty.int(), empty.int(), torch.ones(1, 4), table)

    def recolored(*amounts: float) -> torch.Tensor:
        return transforms.recolor(one, torch.tensor([[amounts, amounts]])).curr_color.float()

    before = color.float()
    torch.testing.assert_close(recolored(0.2, 0, 0, 0), before * 1.2)
    torch.testing.assert_close(recolored(0, 0.5, 0, 0), ((before - before.mean()) * 1.5 + before.mean()).round())
    gray = recolored(0, 0, -1, 0)
    assert float((gray.amax(1) - gray.amin(1)).max()) <= 1
    luma = torch.tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    turned = recolored(0, 0, 0, 0.8)
    assert float(((turned - before) * luma).sum(1).abs().max()) < 1.5
    assert float((turned - before).abs().max()) > 10


@pytest.mark.parametrize(
    "bad",
    [
        {"flip": 1.5},
        {"zoom": 0.9},
        {"hue": -0.1},
        {"sensors": 0},
        {"kinds": ("lidar",)},
        {"kinds": ()},
        {"strength": (2.0, 1.0)},
        {"scale": (0.0, 1.0)},
        {"turn": 2.0},
        {"swap": float("nan")},
    ],
)
def test_settings_are_checked(bad: dict[str, float]) -> None:
    with pytest.raises(DatasetError, match="augmentation"):
        AugmentSettings(**bad)  # type: ignore[arg-type]


def with_camera_motion(batch: Batch) -> Batch:
    """The batch with a camera that rotated about an oblique axis and moved."""
    motion = torch.eye(4)
    motion[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.03, 0.02], [0.03, 0, -0.05], [-0.02, 0.05, 0]]))
    motion[:3, 3] = torch.tensor([0.01, -0.02, 0.03])
    return dataclasses.replace(batch, camera_motion=motion.expand(len(batch), 4, 4).clone())


def test_the_camera_is_mirrored_turned_and_scaled_with_the_scene(batch: Batch) -> None:
    """The transformed motion maps the transformed image of a world point."""
    batch = with_camera_motion(batch)
    assert batch.camera_motion is not None
    curr = torch.tensor([0.1, -0.2, 0.7, 1.0])
    prev = batch.camera_motion[0] @ curr
    mirror = torch.tensor([-1.0, 1, 1, 1])
    flipped, swapped = transforms.flip(batch, EVERY), transforms.swap(batch, EVERY)
    turned, scaled = transforms.turn(batch, 1), transforms.rescale(batch, torch.full((3,), 2.0))
    assert turned.camera_motion is not None
    assert scaled.camera_motion is not None
    quarter = torch.tensor([-0.2, -0.1, 0.7, 1.0])  # x is y, y is -x
    torch.testing.assert_close((turned.camera_motion[0] @ quarter)[:3], torch.stack([prev[1], -prev[0], prev[2]]))
    larger = torch.tensor([2.0, 2, 2, 1])
    torch.testing.assert_close(scaled.camera_motion[0] @ (larger * curr), larger * prev)
    assert flipped.camera_motion is not None
    assert swapped.camera_motion is not None
    torch.testing.assert_close(flipped.camera_motion[0] @ (mirror * curr), mirror * prev)
    torch.testing.assert_close(swapped.camera_motion[0] @ prev, curr)
