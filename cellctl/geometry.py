"""Rigid transforms that carry their frames: `p_parent = T_parent_child @ p_child`, metres."""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from cellctl.errors import BadInput, FrameError

Array = NDArray[Any]
"""Of float64 unless a docstring says otherwise; shapes are in the docstrings."""
Mask = NDArray[Any]
"""Of bool."""

RIGID_TOLERANCE = 2e-3
"""How far R^T R may be from the identity before a matrix is refused. Rotations that were printed
with three decimals pass, for they are off by 2 sqrt(3) 5e-4 at most; a swapped axis or a scaled
rotation does not. What passes is projected onto the nearest rotation."""


@dataclass(frozen=True, eq=False)
class Transform:
    """A rigid transform from frame `child` to frame `parent`; `matrix` is (4, 4) and read-only.

    Raises BadInput when the matrix has another shape, is not finite or is not rigid.
    """

    parent: str
    child: str
    matrix: Array = field(repr=False)

    def __post_init__(self) -> None:
        matrix = rigid(self.matrix, f"T_{self.parent}_{self.child}")
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    def __matmul__(self, other: Transform) -> Transform:
        """Compose; FrameError unless `self.child == other.parent`."""
        if self.child != other.parent:
            raise FrameError(
                f"T_{self.parent}_{self.child} @ T_{other.parent}_{other.child}: "
                f"the inner frames {self.child!r} and {other.parent!r} differ"
            )
        return Transform(self.parent, other.child, self.matrix @ other.matrix)

    def inverse(self) -> Transform:
        return Transform(self.child, self.parent, invert(self.matrix))

    def apply(self, points: ArrayLike) -> Array:
        """Map points (..., 3) from `child` to `parent` coordinates, metres."""
        return transform_points(self.matrix, np.asarray(points, dtype=float))

    @property
    def rotation(self) -> Array:
        return self.matrix[:3, :3]

    @property
    def translation(self) -> Array:
        return self.matrix[:3, 3]

    @property
    def rvec(self) -> Array:
        """Rotation vector (3,), radians."""
        return Rotation.from_matrix(self.rotation).as_rotvec()

    @classmethod
    def from_rvec(cls, parent: str, child: str, rvec: ArrayLike, tvec: ArrayLike) -> Transform:
        """From a rotation vector (3,) in radians and a translation (3,) in metres."""
        return cls(parent, child, pose_matrix(rvec, tvec))

    @classmethod
    def from_rpy_deg(cls, parent: str, child: str, rpy: ArrayLike, xyz: ArrayLike) -> Transform:
        """From roll, pitch, yaw in degrees about the fixed x, y, z axes (REP-103), metres."""
        rotation = Rotation.from_euler("xyz", np.asarray(rpy, dtype=float), degrees=True)
        return cls(parent, child, pose_matrix(rotation.as_rotvec(), xyz))

    @classmethod
    def identity(cls, parent: str, child: str) -> Transform:
        return cls(parent, child, np.eye(4))

    def to_list(self) -> list[list[float]]:
        """Row-major nested lists, as every file of cellctl stores a transform."""
        rows: list[list[float]] = self.matrix.tolist()
        return rows


def rigid(value: ArrayLike, name: str) -> Array:
    """A (4, 4) copy of `value`, its rotation made exact. BadInput names what is wrong with it."""
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{name} is not a matrix of numbers: {error}") from None
    if matrix.shape != (4, 4):
        raise BadInput(f"{name} must be a 4x4 matrix, not of shape {matrix.shape}")
    if not isinstance(value, np.ndarray):
        _check_leaves(value, name)
    if not np.isfinite(matrix).all():
        raise BadInput(f"{name} holds a number that is not finite")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise BadInput(f"{name} is not rigid: its last row is {matrix[3].tolist()}, not 0 0 0 1")
    matrix[:3, :3] = _nearest_rotation(matrix[:3, :3], name)
    return matrix


def _check_leaves(rows: Any, name: str) -> None:
    """BadInput on text, null or true in a (4, 4) nested list: NumPy reads them as numbers."""
    for leaf in (leaf for row in rows for leaf in row):
        if isinstance(leaf, bool) or not isinstance(leaf, Real):
            raise BadInput(f"{name} is not a matrix of numbers: it holds {leaf!r}")


def _nearest_rotation(block: Array, name: str) -> Array:
    if np.linalg.det(block) < 0:
        raise BadInput(f"{name} is not rigid: it mirrors (determinant < 0)")
    defect = np.abs(block.T @ block - np.eye(3)).max()
    if defect > RIGID_TOLERANCE:
        raise BadInput(f"{name} is not rigid: R^T R differs from the identity by {defect:.2g}")
    if defect < 1e-12:
        return block
    u, _, vt = np.linalg.svd(block)
    return u @ vt


def pose_matrix(rvec: ArrayLike, tvec: ArrayLike) -> Array:
    """(4, 4) from a rotation vector (3,) in radians and a translation (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.asarray(rvec, dtype=float).reshape(3)).as_matrix()
    matrix[:3, 3] = np.asarray(tvec, dtype=float).reshape(3)
    return matrix


def invert(matrix: Array) -> Array:
    """Inverse of rigid matrices (..., 4, 4)."""
    rotation_t = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result = np.zeros_like(matrix)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -(rotation_t @ matrix[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def transform_points(matrix: Array, points: Array) -> Array:
    """Apply one (4, 4) matrix to points (..., 3)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def rotation_angle(matrix: Array) -> float:
    """Angle in radians of the rotation block of a (3, 3) or (4, 4) matrix."""
    return float(np.linalg.norm(Rotation.from_matrix(matrix[:3, :3]).as_rotvec()))


def look_down(position: ArrayLike, aim: ArrayLike, yaw: float = 0.0) -> Array:
    """(4, 4) pose of an optical frame at `position` that looks at `aim`.

    z points at `aim`; with `yaw` = 0 the image's x axis lies in the plane of the parent's x axis.
    """
    position, aim = np.asarray(position, dtype=float), np.asarray(aim, dtype=float)
    z = (aim - position) / np.linalg.norm(aim - position)
    hint = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    y = np.cross(z, hint)
    y /= np.linalg.norm(y)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    matrix[:3, 3] = position
    return matrix


def as_transform(parent: str, child: str, value: Any, where: str = "") -> Transform:
    """A Transform read from outside; BadInput says `where`."""
    try:
        return Transform(parent, child, value)
    except BadInput as error:
        raise BadInput(f"{where}: {error.message}" if where else error.message) from None
