"""Random arrays as input of `RgbdFrame`: accepted frames keep their guarantees, others raise `ObjectflowError`."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from objectflow.errors import ObjectflowError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.camera import Camera
from objectflow.typing import Float32Array

CAMERA = Camera(width=4, height=3, fx=4.0, fy=4.0, cx=1.5, cy=1.0)
dtypes = st.sampled_from([np.uint8, np.uint16, np.int32, np.float16, np.float32, np.float64, np.complex64, np.bool_])
shapes = st.sampled_from([(3, 4, 3), (3, 4), (4, 3), (3, 4, 1), (3, 4, 4), (12,), (0, 0), ()])
arrays = st.builds(lambda dtype, shape: (dtype, shape), dtypes, shapes).flatmap(lambda p: hnp.arrays(p[0], p[1]))
depths = hnp.arrays(np.float32, (3, 4), elements=st.floats(width=32) | st.floats(0.5, 2, width=32) | st.just(0.0))
colors = hnp.arrays(np.uint8, (3, 4, 3))


@given(color=colors | arrays | st.none() | st.text(max_size=3), depth=depths | arrays | st.none() | st.integers())
@settings(max_examples=300, deadline=None, derandomize=True)
def test_random_arrays(color: Any, depth: Any) -> None:
    try:
        frame = RgbdFrame(color=color, depth=depth, camera=CAMERA)
    except ObjectflowError:
        return
    assert (frame.color.dtype, frame.color.shape) == (np.uint8, (3, 4, 3))
    assert (frame.depth.dtype, frame.depth.shape) == (np.float32, (3, 4))
    assert np.isfinite(frame.depth).all()
    assert (frame.depth >= 0).all()
    assert frame.valid.any()
    check_pair(frame, frame)


@given(depth=hnp.arrays(np.float32, (3, 4), elements=st.floats(0.25, 20, width=32) | st.just(0.0)))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_valid_depth_is_kept_unchanged(depth: Float32Array) -> None:
    depth[0, 0] = 1.0
    frame = RgbdFrame(color=np.zeros((3, 4, 3), np.uint8), depth=depth, camera=CAMERA)
    np.testing.assert_array_equal(frame.depth, depth)
