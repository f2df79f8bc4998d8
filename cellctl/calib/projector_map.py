"""Where the camera sees each projector pixel on the table: homography and projector lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import coefficient_slopes, distort, distort_slopes, undistort
from cellctl.errors import BadInput
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class ProjectorMap:
    """Undistorted normalised camera coordinates on the table <-> projector pixels, both ways.

    `H` (3, 3) leads to the pixels of a projector without distortion, with H[2, 2] = 1; `radial`
    (2,) k1, k2 then act about `centre` (2,) px at the focal length `focal_px`, as in a camera.
    From one plane focal length and pose of a projector cannot be told apart, so this map is all
    that a table shows: it is right on the table only.
    """

    H: Array
    centre: Array
    focal_px: float
    radial: Array

    def __post_init__(self) -> None:
        for name, shape in (("H", (3, 3)), ("centre", (2,)), ("radial", (2,))):
            object.__setattr__(self, name, _finite(getattr(self, name), name, shape))
        focal = _finite(self.focal_px, "focal_px", ())
        if focal <= 0 or abs(np.linalg.det(self.H)) < 1e-12:
            raise BadInput("projector map: the focal length must be positive and H invertible")
        object.__setattr__(self, "focal_px", float(focal))

    @classmethod
    def pinhole(cls, H: Array) -> ProjectorMap:
        """A homography alone."""
        return cls(H, np.zeros(2), 1.0, np.zeros(2))

    def project(self, xy: Array) -> Array:
        """Projector pixels (..., 2) of normalised camera coordinates (..., 2)."""
        ideal = apply_homography(self.H, xy)
        if not self.radial.any():
            return ideal
        lens = (ideal - self.centre) / self.focal_px
        return distort(lens, self._coefficients) * self.focal_px + self.centre

    def locate(self, pixels: Array) -> Array:
        """Inverse of `project`, to rounding."""
        pixels = np.asarray(pixels, dtype=float)
        if self.radial.any():
            lens = undistort((pixels - self.centre) / self.focal_px, self._coefficients)
            pixels = lens * self.focal_px + self.centre
        return apply_homography(np.linalg.inv(self.H), pixels)

    def lens_jacobians(self, ideal: Array) -> tuple[Array, Array, Array, Array]:
        """Pixels (n, 2) of undistorted pixels (n, 2), and their derivatives by these (n, 2, 2),
        by k1, k2 (n, 2, 2) and by the centre (n, 2, 2)."""
        lens = (ideal - self.centre) / self.focal_px
        warped, by_lens = distort_slopes(lens, self._coefficients)
        by_radial = coefficient_slopes(lens)[..., :2] * self.focal_px
        pixels = warped * self.focal_px + self.centre
        return pixels, by_lens, by_radial, np.eye(2) - by_lens

    @property
    def _coefficients(self) -> Array:
        return np.array([*self.radial, 0.0, 0.0, 0.0])

    def to_dict(self) -> dict[str, Any]:
        return {
            "H": self.H.tolist(),
            "centre_px": self.centre.tolist(),
            "focal_px": self.focal_px,
            "radial": self.radial.tolist(),
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "projector") -> ProjectorMap:
        """Read `to_dict`'s form. BadInput says `where` and what is wrong."""
        try:
            return cls(value["H"], value["centre_px"], value["focal_px"], value["radial"])
        except (KeyError, TypeError) as error:
            raise BadInput(
                f"{where}: needs H, centre_px, focal_px and radial ({error!r})"
            ) from None
        except BadInput as error:
            raise BadInput(f"{where}: {error.message}") from None


def apply_homography(H: Array, points: Array) -> Array:
    """Points (..., 2) mapped by H (3, 3)."""
    mapped = np.asarray(points, dtype=float) @ H[:, :2].T + H[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def homography_jacobian(H: Array, points: Array) -> tuple[Array, Array]:
    """`apply_homography` and its derivatives (n, 2, 8) by H's first eight entries."""
    p = np.concatenate([points, np.ones_like(points[:, :1])], axis=1)
    w = (p @ H[2])[:, None]
    mapped = p @ H[:2].T / w
    jacobian = np.zeros((len(p), 2, 8))
    jacobian[:, 0, :3] = jacobian[:, 1, 3:6] = p / w
    jacobian[:, :, 6:] = -mapped[:, :, None] * (points / w)[:, None, :]
    return mapped, jacobian


def direct_linear_transform(source: Array, target: Array) -> Array:
    """H (..., 3, 3) with H[2, 2] = 1 that maps source (..., n, 2) to target (..., n, 2), n >= 4.

    Least squares of the algebraic error on normalised points: Hartley and Zisserman, Multiple
    View Geometry, 2nd edition, algorithm 4.2.
    """
    S, T = _normaliser(source), _normaliser(target)
    a, b = _affine(S, source), _affine(T, target)
    ones, zeros = np.ones_like(a[..., :1]), np.zeros_like(a)
    p = np.concatenate([a, ones], axis=-1)
    zero = np.concatenate([zeros, 0 * ones], axis=-1)
    rows = np.concatenate(
        [
            np.concatenate([p, zero, -b[..., :1] * p], axis=-1),
            np.concatenate([zero, p, -b[..., 1:] * p], axis=-1),
        ],
        axis=-2,
    )
    H = np.linalg.svd(rows)[2][..., -1, :].reshape(*rows.shape[:-2], 3, 3)
    H = np.linalg.inv(T) @ H @ S
    return H / H[..., 2:, 2:]


def _normaliser(points: Array) -> Array:
    """Similarity (..., 3, 3) that moves the centroid to 0 and the mean distance to sqrt(2)."""
    centre = points.mean(axis=-2)
    distance = np.linalg.norm(points - centre[..., None, :], axis=-1).mean(axis=-1)
    scale = np.sqrt(2.0) / np.maximum(distance, 1e-300)
    matrix = np.zeros((*centre.shape[:-1], 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = scale
    matrix[..., :2, 2] = -centre * scale[..., None]
    matrix[..., 2, 2] = 1.0
    return matrix


def _affine(matrix: Array, points: Array) -> Array:
    return points * matrix[..., 0, 0][..., None, None] + matrix[..., None, :2, 2]


def _finite(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadInput(f"projector map: {name} is not made of numbers: {error}") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise BadInput(f"projector map: {name} must be finite and of the shape {shape}")
    array.flags.writeable = False
    return array
