"""Pictures of a scene: colour with textures and shadows, planar depth and labels, ray-traced by mujoco-warp."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.rendering.camera_rays import pixel_rays
from objectflow.synth.rendering.placement import Placement, object_numbers
from objectflow.synth.rendering.warp_scene import TracedData, TracedModel, tighten
from objectflow.synth.rendering.warp_setup import cycles_freed, find_warp_device, import_tracer, quiet
from objectflow.typing import Float32Array, LabelImage, UInt8Array

DEPTH_CLIP = float(2**20)
"""Metres at which mujoco-warp's reader of depth clips; a power of two, so that scaling loses no bit."""
LIT_IN_SHADOW = 0.0
"""Share of a light that reaches what it does not see: none. The lights' own ambient part fills shadows."""
BACKDROP = (0.45, 0.46, 0.48, 1.0)
"""Colour, RGBA, of what lies beyond the horizon of the floor."""
VISIBLE_GROUP = 0
"""Group of the geoms that are seen; collision hulls are in another."""

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True, eq=False)
class Frames:
    """F frames of a scene, each seen by C cameras."""

    color: UInt8Array
    """(F, C, H, W, 3) RGB."""
    depth: Float32Array
    """(F, C, H, W) metres along the optical axis at the pixel's centre; 0 where nothing is hit."""
    labels: LabelImage
    """(F, C, H, W) from the same ray as depth: k = object k, 0 = floor or nothing."""


class Renderer:
    """Renders scenes of one image size; keep it from scene to scene, so that its kernel is compiled once.

    Args:
        width, height: pixels.
        samples: rays a pixel for colour, 1 or 4. The first goes through the pixel's centre and gives depth and label
            too; the other three lie around it. They are averaged as they are displayed: the renderer's light is
            not linear either.
        device: "cpu" (one core) or "cuda".

    Raises:
        MissingExtraError: mujoco-warp is not installed.
        ObjectflowError: CUDA where there is none, or a number of samples that cannot be had.
    """

    def __init__(self, width: int, height: int, *, samples: int = 1, device: Device = "cpu") -> None:
        if samples not in (1, 4):
            raise ObjectflowError(f"a pixel has 1 or 4 colour samples, not {samples}")
        self._width, self._height, self._samples = width, height, samples
        self._warp, self._tracer = import_tracer()
        self._device = find_warp_device(self._warp, device)
        self._kernels: dict[Any, Any] = {}

    def render(
        self, model: Any, world_T_objects: NDArray[np.floating], world_T_cameras: NDArray[np.floating]
    ) -> Frames:
        """Render every frame through every camera.

        Args:
            model: a `mujoco.MjModel` with one free body an object, named obj_1..obj_N; visible geoms in group 0; a
                camera named `camera`, whose intrinsics count. Its lights are used as they stand; the headlight is not.
            world_T_objects: (F, N, 4, 4) poses of the objects in metres.
            world_T_cameras: (C, 4, 4) poses of the cameras, x right, y down, z forward.

        Raises:
            DatasetError: poses that do not fit the model.
        """
        numbers = object_numbers(model)
        frames, cameras = len(world_T_objects), len(world_T_cameras)
        expected = (frames, int(numbers.max(initial=0)), 4, 4)
        if world_T_objects.shape != expected or world_T_cameras.shape != (cameras, 4, 4):
            raise DatasetError(
                f"object poses {world_T_objects.shape} and camera poses {world_T_cameras.shape} do not fit the scene: "
                f"it needs {expected} and {(cameras, 4, 4)}"
            )
        placement = Placement.of(model, numbers, world_T_objects, world_T_cameras)
        with cycles_freed(), quiet(self._warp), self._warp.ScopedDevice(self._device):
            color, depth, geoms = self._trace(model, placement)
        shape = (frames, cameras, self._height, self._width)
        # Geom -1, nothing hit, finds the 0 that is appended.
        labels = np.append(numbers, 0).astype(np.int32)[geoms]
        return Frames(color.reshape(*shape, 3), depth.reshape(shape), labels.reshape(shape))

    def _trace(self, model: Any, placement: Placement) -> tuple[UInt8Array, Float32Array, LabelImage]:
        """Colour (B, H, W, 3), depth (B, H, W) and geom number (B, H, W), -1 = none, of B placements."""
        wp, tracer = self._warp, self._tracer
        worlds = len(placement.camera_position)
        on_device, data = TracedModel(tracer, wp, model), TracedData.of(wp, placement)
        context = self._create_context(model, worlds)
        tracer.refit_bvh(on_device, data, context)
        tighten(model, placement, context)
        tracer.render(on_device, data, context)
        self._kernels.setdefault(_kernel_key(model, context), context._megakernel)

        shape = (worlds, self._height, self._width)
        color = wp.empty(shape, dtype=wp.vec3)
        depth = wp.empty(shape, dtype=wp.float32)
        geoms = wp.empty(shape, dtype=wp.vec2i)
        tracer.get_rgb(context, 0, color)
        tracer.get_depth(context, 0, DEPTH_CLIP, depth)
        tracer.get_segmentation(context, 0, geoms)
        return (
            np.rint(color.numpy() * 255).astype(np.uint8),
            depth.numpy() * np.float32(DEPTH_CLIP),
            geoms.numpy()[..., 0],
        )

    def _create_context(self, model: Any, worlds: int) -> Any:
        # The context steps the model once, as it was compiled; objects that overlap there are none of our business.
        flags = int(model.opt.disableflags)
        model.opt.disableflags = -1
        try:
            context = self._new_context(model, worlds)
        finally:
            model.opt.disableflags = flags
        # These numbers are compiled into the kernel and differ from scene to scene; fixed ones that serve every scene
        # spare a compilation each. The range only culls (0: not at all), and the rays are our own.
        context.znear, context.zfar = 1.0, 0.0
        context.headlight_active = False
        context.headlight_ambient = context.headlight_diffuse = context.headlight_specular = self._warp.vec3(0.0)
        context.light_attenuation_is_default, context.has_spot_lights = False, True
        context.ray.assign(pixel_rays(model, self._width, self._height, self._samples))
        # The kernel itself is kept too: making it anew leaks, even where its code is found compiled.
        context._megakernel = self._kernels.get(_kernel_key(model, context))
        return context

    def _new_context(self, model: Any, worlds: int) -> Any:
        return self._tracer.create_render_context(
            model,
            nworld=worlds,
            cam_res=(self._width, self._height),
            cam_active=["camera"],
            render_rgb=True,
            render_depth=True,
            render_seg=True,
            use_textures=True,
            use_shadows=True,
            use_fast_math=False,
            enabled_geom_groups=[VISIBLE_GROUP],
            background_color=BACKDROP,
            shadow_light_fraction=LIT_IN_SHADOW,
            samples_per_pixel=round(self._samples**0.5),
        )


def _kernel_key(model: Any, context: Any) -> Any:
    """What may still differ between two scenes' kernels."""
    return context.geom_ray_types, int(model.nlight)
