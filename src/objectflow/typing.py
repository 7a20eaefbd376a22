"""The array types that signatures use; their docstrings give shapes, units and frames."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Float32Array: TypeAlias = NDArray[np.float32]
Float64Array: TypeAlias = NDArray[np.float64]
UInt8Array: TypeAlias = NDArray[np.uint8]
Int32Array: TypeAlias = NDArray[np.int32]
Int64Array: TypeAlias = NDArray[np.int64]
IndexArray: TypeAlias = NDArray[np.intp]
"""Positions along an axis."""
BoolMask: TypeAlias = NDArray[np.bool_]
LabelImage: TypeAlias = NDArray[np.int32]
"""0 = background, 1..K = objects."""
