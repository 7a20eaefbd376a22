"""Sensor models against analytic results: shadow widths, quantisation steps, slants, noise levels, ranges."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from objectflow.errors import DatasetError
from objectflow.sensors import depth_maps as maps
from objectflow.sensors.sensor import (
    SENSORS,
    ColorSensor,
    Stereo,
    StructuredLight,
    TimeOfFlight,
    observe,
    observe_color,
    observe_depth,
    scaled,
)

WIDTH, HEIGHT, FOCAL = 160, 120, 236.46
INTRINSICS = torch.tensor([[FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]], dtype=torch.float64)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def wall(z: float) -> Tensor:
    return torch.full((1, HEIGHT, WIDTH), z, dtype=torch.float64)


def grey(level: float = 0.8) -> Tensor:
    return torch.full((1, 3, HEIGHT, WIDTH), level, dtype=torch.float64)


def slanted(degrees: float, z: float = 0.6) -> Tensor:
    """A plane rotated about the camera's y axis: z + x tan(angle) = const, through (0, 0, z)."""
    ray = (torch.arange(WIDTH, dtype=torch.float64) - INTRINSICS[0, 2]) / FOCAL
    return (z / (1 + ray * math.tan(math.radians(degrees)))).expand(1, HEIGHT, WIDTH).clone()


def box(front: float, back: float, left: int, right: int) -> Tensor:
    depth = wall(back)
    depth[:, 40:80, left:right] = front
    return depth


def test_cosine_of_a_slanted_plane_is_its_angle() -> None:
    for degrees in (0.0, 30.0, 60.0):
        inverse = maps.inverse_depth(slanted(degrees))
        x, y, step = maps.slopes(inverse)
        cos = maps.cosine(inverse, x, y, INTRINSICS)
        # The ray through column u is inclined by atan(ray), the normal by the plane's angle in the opposite direction.
        ray = (torch.arange(WIDTH, dtype=torch.float64) - INTRINSICS[0, 2]) / FOCAL
        expected = torch.cos(torch.atan(ray) - math.radians(degrees))
        torch.testing.assert_close(cos[0, HEIGHT // 2], expected, atol=2e-3, rtol=0)
        assert step.max() < 1e-9


def test_a_step_is_located_exactly_and_is_no_slope() -> None:
    x, _, step = maps.slopes(maps.inverse_depth(box(0.5, 1.0, 60, 100)))
    assert x.abs().max() == 0
    assert step[0, 60].nonzero().flatten().tolist() == [59, 60, 99, 100]
    assert step.max() == pytest.approx(1 / 0.5 - 1 / 1.0)


@pytest.mark.parametrize(("baseline", "side"), [(0.048, "left"), (-0.048, "right")])
def test_the_width_of_the_shadow_is_the_difference_of_disparities(baseline: float, side: str) -> None:
    front, back, left, right = 0.4, 0.8, 60, 110
    inverse = maps.inverse_depth(box(front, back, left, right))
    dark = maps.occluded(inverse, torch.tensor([FOCAL * baseline], dtype=torch.float64))
    width = FOCAL * abs(baseline) * (1 / front - 1 / back)  # 14.2 columns
    assert abs(int(dark[0, 60].sum()) - width) <= 1.5
    columns = dark[0, 60].nonzero().flatten()
    if side == "left":
        assert columns.max() == left - 1
    else:
        assert columns.min() == right
    assert not dark[0, :38].any()
    assert not maps.occluded(maps.inverse_depth(slanted(40)), torch.tensor([FOCAL * 0.048])).any()


def test_the_shadow_of_a_thin_object_is_separate_from_it() -> None:
    inverse = maps.inverse_depth(box(0.4, 0.8, 80, 84))
    dark = maps.occluded(inverse, torch.tensor([FOCAL * 0.048], dtype=torch.float64))
    columns = dark[0, 60].nonzero().flatten().tolist()
    # 14.2 columns to the left of the object's columns 80..83 and of its width; the background between them is lit.
    assert 3 <= len(columns) <= 6
    assert 64 <= min(columns) <= 67
    assert max(columns) <= 71


@pytest.mark.parametrize("name", sorted(SENSORS))
def test_same_seed_same_frame_and_missing_stays_missing(name: str) -> None:
    depth = box(0.4, 0.8, 60, 100)
    depth[:, :10] = 0
    color = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator(5), dtype=torch.float64) * 0.5 + 0.5
    a, b, c = (observe_depth(depth, color, INTRINSICS, SENSORS[name], generator(s)) for s in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)
    assert (a[:, :10] == 0).all()
    assert a.isfinite().all()
    assert (a >= 0).all()
    kept = a > 0
    assert kept[:, 10:].double().mean() > 0.75
    assert (a[kept] - depth[kept]).abs().median() < 0.01


def test_structured_light_gives_whole_disparity_steps() -> None:
    sensor = StructuredLight()
    seen = observe_depth(wall(0.7), grey(), INTRINSICS, sensor, generator())
    steps = sensor.focal * sensor.baseline * sensor.steps / seen[seen > 0]
    torch.testing.assert_close(steps, steps.round(), atol=1e-6, rtol=0)
    # At 0.7 m one step is z^2 / (8 f b) = 2.7 mm; only the steps next to the wall's depth occur.
    assert len(steps.round().unique()) <= 3
    assert (seen[seen > 0] - 0.7).abs().max() < 1.6 * 0.7**2 / (sensor.focal * sensor.baseline * sensor.steps)


def test_structured_light_drops_dark_slanted_and_distant_surfaces() -> None:
    sensor = StructuredLight()

    def lost(depth: Tensor, level: float) -> float:
        seen = observe_depth(depth, grey(level), INTRINSICS, sensor, generator())
        return float((seen == 0).double().mean())

    assert lost(wall(0.6), 0.8) < 0.02
    assert lost(wall(0.6), 0.04) > 0.9
    assert lost(slanted(60), 0.8) < 0.15
    assert lost(slanted(84), 0.8) > 0.5
    assert lost(wall(1.6), 0.8) == 1
    assert lost(wall(0.1), 0.8) == 1


def test_structured_light_drops_the_shadow_and_part_of_the_edges() -> None:
    depth = box(0.4, 0.8, 60, 110)
    seen = observe_depth(depth, grey(), INTRINSICS, StructuredLight(), generator())
    assert (seen[0, 45:75, 48:59] == 0).double().mean() > 0.95
    far_side = (seen[0, 45:75, 109:111] == 0).double().mean()
    assert 0.2 < far_side < 0.8


def test_time_of_flight_noise_grows_with_distance_as_amplitude_falls() -> None:
    sensor = TimeOfFlight(wiggle=0.0, stray=0.0)

    def noise(z: float) -> float:
        return float((observe_depth(wall(z), grey(1.0), INTRINSICS, sensor, generator()) - z).std())

    # sigma ~ 1 / sqrt(light) and light ~ 1 / z^2, so that noise doubles with distance.
    assert noise(1.0) / noise(0.5) == pytest.approx(2.0, rel=0.1)
    assert noise(0.5) == pytest.approx(sensor.sigma, rel=0.1)


def test_time_of_flight_mixes_front_and_back_only_at_edges() -> None:
    sensor = TimeOfFlight(sigma=1e-6, wiggle=0.0, stray=0.0)
    depth = box(0.4, 0.8, 60, 110)
    seen = observe_depth(depth, grey(), INTRINSICS, sensor, generator())
    between = (seen > 0.41) & (seen < 0.79)
    assert between[0, 60, 58:62].any()
    columns = between[0, 60].nonzero().flatten()
    assert {int(c) for c in columns} <= {57, 58, 59, 60, 61, 62, 107, 108, 109, 110, 111, 112}


def test_time_of_flight_wiggles_by_its_amplitude() -> None:
    sensor = TimeOfFlight(sigma=1e-7, stray=0.0, wiggle=0.002)
    depth = slanted(50, 0.8)
    error = observe_depth(depth, grey(), INTRINSICS, sensor, generator()) - depth
    inner = error[:, 4:-4, 4:-4][depth[:, 4:-4, 4:-4] < 1.0]
    assert float(inner.max()) == pytest.approx(0.002, rel=0.1)
    assert float(inner.min()) == pytest.approx(-0.002, rel=0.1)


def test_stereo_noise_is_the_published_formula() -> None:
    sensor = Stereo(steps=1e4)
    for z in (0.5, 1.0):
        seen = observe_depth(wall(z), grey(), INTRINSICS, sensor, generator())
        expected = z**2 * sensor.disparity_sigma / (sensor.focal * sensor.baseline)
        assert float((seen - z).std()) == pytest.approx(expected, rel=0.15)


def test_noisy_stereo_has_the_measured_difference_between_two_frames() -> None:
    depth, color = wall(1.5).expand(8, -1, -1), torch.rand(8, 3, HEIGHT, WIDTH, generator=generator(3))
    seen = observe_depth(depth, color.double(), INTRINSICS.repeat(8, 1), SENSORS["noisy-stereo"], generator())
    both = (seen[::2] > 0) & (seen[1::2] > 0)
    difference = (seen[::2] - seen[1::2]).abs()[both]
    assert float(difference.median()) == pytest.approx(0.014, rel=0.15)
    assert float(difference.quantile(0.9)) == pytest.approx(0.046, rel=0.15)
    # Twice as far, the errors of disparity are four times as large in depth.
    near = observe_depth(depth / 2, color.double(), INTRINSICS.repeat(8, 1), SENSORS["noisy-stereo"], generator())
    closer = (near[::2] - near[1::2]).abs()[(near[::2] > 0) & (near[1::2] > 0)]
    assert float(difference.median() / closer.median()) == pytest.approx(4, rel=0.15)


def test_noise_in_patches_is_correlated_further_than_the_window() -> None:
    def correlation(sensor: Stereo, apart: int) -> float:
        error = 1 / observe_depth(wall(1.0), grey(), INTRINSICS, sensor, generator()) - 1.0
        pairs = torch.stack([error[:, :, :-apart].flatten(), error[:, :, apart:].flatten()])
        return float(torch.corrcoef(pairs)[0, 1])

    assert abs(correlation(Stereo(steps=1e4), 8)) < 0.1
    # A moving average over 2 r + 1 pixels has the correlation 1 - d / (2 r + 1) at the distance d.
    patches = Stereo(steps=1e4, patch=10, patch_share=1.0)
    assert correlation(patches, 8) == pytest.approx(1 - 8 / 21, abs=0.1)


def test_foreground_grows_by_the_fattening() -> None:
    depth = box(0.5, 1.0, 60, 100)
    scale = FOCAL / 640
    exact = Stereo(disparity_sigma=0.0, wobble=0.0, edge_loss=0.0, steps=1e4)
    fat = Stereo(disparity_sigma=0.0, wobble=0.0, edge_loss=0.0, steps=1e4, fattening=2 / scale)
    grown = [
        float(
            (
                observe_depth(depth, grey(), INTRINSICS, sensor, generator())[:, 50:70, 90:130].sub(0.5).abs() < 0.01
            ).sum()
        )
        for sensor in (exact, fat)
    ]
    assert (grown[1] - grown[0]) / 20 == pytest.approx(2, abs=0.7)
    torch.testing.assert_close(
        observe_depth(slanted(50), grey(), INTRINSICS, fat, generator()), slanted(50), rtol=1e-3, atol=0
    )


def test_holes_lie_on_surfaces_without_texture() -> None:
    textured = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator(3), dtype=torch.float64)
    sensor = Stereo(hole_loss=0.3, patch=4)
    for color, share in ((grey(), 0.3), (textured, 0.0)):
        seen = observe_depth(wall(0.7), color, INTRINSICS, sensor, generator())
        assert float((seen == 0).double().mean()) == pytest.approx(share, abs=0.06)


def test_passive_stereo_needs_texture_and_active_does_not() -> None:
    textured = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator(3), dtype=torch.float64)
    for active, color, low, high in ((True, grey(), 0, 0.02), (False, grey(), 0.9, 1), (False, textured, 0, 0.1)):
        seen = observe_depth(wall(0.7), color, INTRINSICS, Stereo(active=active), generator())
        assert low <= float((seen == 0).double().mean()) <= high


def test_each_image_of_a_batch_has_its_own_intrinsics_and_noise() -> None:
    depth, color = wall(0.6).expand(2, -1, -1), grey().expand(2, -1, -1, -1)
    intrinsics = INTRINSICS.repeat(2, 1)
    seen = observe_depth(depth, color, intrinsics, Stereo(), generator())
    assert not torch.equal(seen[0], seen[1])


def test_colour_noise_has_the_variance_of_its_model() -> None:
    sensor = ColorSensor(exposure=0.0, balance=0.0, blur=(0, 0), gain=(0.002, 0.002), read=(0.003, 0.003))
    seen = observe_color(grey(0.6), sensor, generator())
    linear = 0.6**2.2
    # The display curve scales the noise by its slope, d(x^(1/2.2))/dx.
    slope = linear ** (1 / 2.2 - 1) / 2.2
    assert float(seen.std()) == pytest.approx(slope * math.sqrt(0.002 * linear + 0.003**2), rel=0.05)
    assert float(seen.mean()) == pytest.approx(0.6, abs=0.005)
    torch.testing.assert_close(seen * 255, (seen * 255).round())


def test_colour_blur_keeps_the_mean_and_softens_an_edge() -> None:
    sensor = ColorSensor(exposure=0.0, balance=0.0, blur=(1.0, 1.0), gain=(0, 0), read=(0, 0))
    color = grey(0.2)
    color[..., 80:] = 0.8
    row = observe_color(color, sensor, generator())[0, 0, 60]
    assert (row.diff() >= 0).all()
    assert 0.25 < row[79] < row[80] < 0.8
    # The mean of both sides in linear light, because the kernel is symmetric.
    assert float((row[79] ** 2.2 + row[80] ** 2.2) / 2) == pytest.approx((0.2**2.2 + 0.8**2.2) / 2, abs=0.01)


def test_frames_of_a_pair_share_the_camera_but_not_the_noise() -> None:
    sensor = ColorSensor(exposure=1.0, blur=(0, 0), gain=(0.001, 0.001))
    seen = observe_color(grey(0.4).expand(4, -1, -1, -1), sensor, generator(), images_each=2)
    means = seen.mean((2, 3))
    torch.testing.assert_close(means[0], means[1], atol=2e-3, rtol=0)
    assert (means[0] - means[2]).abs().max() > 0.02
    assert not torch.equal(seen[0], seen[1])


def test_exposure_balance_and_gamma_of_each_frame_have_their_spread() -> None:
    still = ColorSensor(exposure=0.0, balance=0.0, blur=(0, 0), gain=(0, 0), read=(0, 0))
    color = grey(0.4)[:, :, :8, :8].expand(4000, -1, -1, -1)
    brighter = observe_color(color, dataclasses.replace(still, frame_exposure=0.2), generator(), images_each=2)
    stops = torch.log2((brighter[:, 1, 0, 0] / 0.4) ** 2.2)
    assert float(stops.std()) == pytest.approx(0.2, rel=0.06)
    assert float((stops[::2] - stops[1::2]).std()) == pytest.approx(0.2 * math.sqrt(2), rel=0.06)
    tinted = observe_color(color, dataclasses.replace(still, frame_balance=0.1), generator(), images_each=2)
    assert float(((tinted[:, 0, 0, 0] / 0.4) ** 2.2).log().std()) == pytest.approx(0.1, rel=0.08)
    torch.testing.assert_close(tinted[:, 1], color[:, 1], atol=1 / 255, rtol=0)
    curved = observe_color(color, dataclasses.replace(still, frame_gamma=0.1), generator(), images_each=2)
    exponents = curved[:, 0, 0, 0].log() / math.log(0.4)
    assert float(exponents.log().std()) == pytest.approx(0.1, rel=0.08)


def test_observe_keeps_images_without_a_sensor_exact() -> None:
    depth, color = wall(0.6), grey(0.5)
    same_color, same_depth = observe(color, depth, INTRINSICS, generator())
    assert same_color is color
    assert same_depth is depth
    _, noisy = observe(color, depth, INTRINSICS, generator(), depth_sensor=StructuredLight())
    assert not torch.equal(noisy, depth)


def test_scaling_changes_the_errors_and_keeps_the_geometry() -> None:
    strong = scaled(StructuredLight(), 2.0)
    assert isinstance(strong, StructuredLight)
    assert strong.lateral_sigma == 1.6
    assert strong.baseline == 0.048


def test_inconsistent_shapes_are_named() -> None:
    with pytest.raises(
        DatasetError, match=r"needs colour \(1, 3, 120, 160\) and intrinsics \(1, 4\), not \(1, 3, 9, 9\)"
    ):
        observe_depth(wall(1.0), torch.zeros(1, 3, 9, 9), INTRINSICS, Stereo(), generator())
