"""The camera model: pinhole and Brown-Conrady distortion, both ways, with exact derivatives.

Pixel centres are at integers. The optical frame is OpenCV's: z forward, x right, y down. Formula:
OpenCV, calib3d, "Detailed Description"; D. C. Brown, Close-range camera calibration, 1971.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.errors import BadInput
from cellctl.geometry import Array

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Order of the intrinsic parameters wherever they form a vector (9,)."""

DISTORTION_MODEL = "plumb_bob"
"""ROS's name for k1 k2 p1 p2 k3."""


@dataclass(frozen=True, eq=False)
class CameraModel:
    """`K` (3, 3) without skew, in pixels; `distortion` (5,) k1 k2 p1 p2 k3; `image_size` (w, h).

    Four coefficients are taken as k3 = 0. Raises BadInput when the numbers describe no camera.
    """

    K: Array
    distortion: Array
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        K = _numbers(self.K, "K", (3, 3))
        if np.any(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != (0, 0, 0, 0, 1)):
            raise BadInput("camera: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise BadInput(f"camera: focal lengths must be positive, not {K[0, 0]}, {K[1, 1]}")
        object.__setattr__(self, "K", _frozen(K))
        object.__setattr__(self, "distortion", _frozen(_coefficients(self.distortion)))
        object.__setattr__(self, "image_size", _size(self.image_size))

    @property
    def vector(self) -> Array:
        """The intrinsic parameters (9,) in the order of INTRINSICS."""
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.distortion])

    @classmethod
    def from_vector(cls, vector: Array, image_size: tuple[int, int]) -> CameraModel:
        """From intrinsic parameters (9,) in the order of INTRINSICS."""
        fx, fy, cx, cy = (float(v) for v in vector[:4])
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return cls(K, vector[4:9], image_size)

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the optical frame, metres.

        Points behind the camera have no picture: their pixels are not-a-number.
        """
        points = np.asarray(points, dtype=float)
        z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return self.pixels(distort(points[..., :2] / z, self.distortion))

    def pixels(self, xy: Array) -> Array:
        """Pixels (..., 2) of distorted normalised coordinates (..., 2): K alone."""
        return xy * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def plane(self, pixels: Array) -> Array:
        """Inverse of `pixels`: still distorted normalised coordinates (..., 2)."""
        return (np.asarray(pixels, dtype=float) - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]

    def normalise(self, pixels: Array) -> Array:
        """Undistorted normalised coordinates x/z, y/z (..., 2) of pixels (..., 2).

        Exact to rounding. Not-a-number where the distortion has no inverse, which for a sound
        calibration is nowhere in the picture.
        """
        return undistort(self.plane(pixels), self.distortion)

    def jacobians(self, points: Array, *, intrinsics: bool = True) -> tuple[Array, Array, Array]:
        """Pixels (..., 2) of points (..., 3), and their derivatives by the point (..., 2, 3) and
        by the intrinsic parameters (..., 2, 9); (..., 2, 0) if these are not wanted."""
        inverse_z = 1.0 / points[..., 2]
        xy = points[..., :2] * inverse_z[..., None]
        warped, by_xy = distort_slopes(xy, self.distortion)
        focal = self.K[[0, 1], [0, 1]]
        by_point = np.empty((*xy.shape, 3))
        by_point[..., :2] = focal[:, None] * by_xy * inverse_z[..., None, None]
        by_point[..., 2] = -(by_point[..., :2] @ xy[..., None])[..., 0]
        by_intrinsics = np.zeros((*xy.shape, 9 if intrinsics else 0))
        if intrinsics:
            by_intrinsics[..., [0, 1], [0, 1]] = warped
            by_intrinsics[..., [0, 1], [2, 3]] = 1.0
            by_intrinsics[..., 4:] = focal[:, None] * coefficient_slopes(xy)
        return self.pixels(warped), by_point, by_intrinsics

    def scaled(self, image_size: tuple[int, int]) -> CameraModel:
        """The same camera read out at another resolution of the same field of view.

        BadInput when the sides are not scaled alike: then the picture was cropped, and by how
        much cannot be known.
        """
        (w, h), (w2, h2) = self.image_size, _size(image_size)
        if abs(w2 / w - h2 / h) > 0.005 * h2 / h:
            raise BadInput(
                f"camera: {w}x{h} and {w2}x{h2} pictures have different shapes; intrinsic "
                "parameters carry over only between resolutions of the same field of view"
            )
        factor = np.array([w2 / w, h2 / h])
        K = self.K.copy()
        K[[0, 1], [0, 1]] *= factor
        K[:2, 2] = (K[:2, 2] + 0.5) * factor - 0.5
        return CameraModel(K, self.distortion, (w2, h2))

    def to_dict(self) -> dict[str, Any]:
        """JSON form; floats survive exactly."""
        return {
            "K": self.K.tolist(),
            "distortion": {"model": DISTORTION_MODEL, "coefficients": self.distortion.tolist()},
            "image_size": list(self.image_size),
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "camera") -> CameraModel:
        """Read `to_dict`'s form. BadInput says `where` and what is wrong."""
        try:
            distortion = value["distortion"]
            model, coefficients = distortion["model"], distortion["coefficients"]
            K, size = value["K"], value["image_size"]
        except (KeyError, TypeError) as error:
            raise BadInput(f"{where}: needs K, distortion and image_size ({error!r})") from None
        if model != DISTORTION_MODEL:
            raise BadInput(f"{where}: distortion model {model!r} is not {DISTORTION_MODEL!r}")
        try:
            return cls(K, coefficients, size)
        except BadInput as error:
            raise BadInput(f"{where}: {error.message.removeprefix('camera: ')}") from None


def distort(xy: Array, coefficients: Array) -> Array:
    """Distorted normalised coordinates (..., 2) of undistorted ones (..., 2)."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    warped = np.empty_like(xy)
    warped[..., 0] = x * radial + p1 * xy2 + p2 * (r2 + 2.0 * xx)
    warped[..., 1] = y * radial + p1 * (r2 + 2.0 * yy) + p2 * xy2
    return warped


def undistort(target: Array, coefficients: Array) -> Array:
    """Inverse of `distort`, to rounding; not-a-number where there is none.

    A few fixed-point steps stay on the branch through the centre, Newton's finish the work.
    """
    xy = np.array(target, dtype=float)
    if not np.any(coefficients):
        return xy
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(6):
            xy += target - distort(xy, coefficients)
        for _ in range(12):
            warped, by_xy = distort_slopes(xy, coefficients)
            step = _solve2(by_xy, target - warped)
            xy += step
            if not np.any(np.abs(step) > 1e-14):
                break
        off = np.abs(distort(xy, coefficients) - target).max(axis=-1)
        folded = np.linalg.det(distort_slopes(xy, coefficients)[1]) <= 0
        xy[~(off < 1e-12 * (1.0 + np.abs(target).max(axis=-1))) | folded] = np.nan
    return xy


def distort_slopes(xy: Array, coefficients: Array) -> tuple[Array, Array]:
    """`distort` with its derivatives by xy (..., 2, 2)."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = xy[..., 0], xy[..., 1]
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    by_xy = np.empty((*xy.shape, 2))
    by_xy[..., 0, 0] = radial + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
    by_xy[..., 1, 1] = radial + yy * slope + 6.0 * p1 * y + 2.0 * p2 * x
    by_xy[..., 0, 1] = by_xy[..., 1, 0] = 0.5 * xy2 * slope + 2.0 * (p1 * x + p2 * y)
    return distort(xy, coefficients), by_xy


def coefficient_slopes(xy: Array) -> Array:
    """Derivatives (..., 2, 5) of `distort` by the coefficients, in which it is linear."""
    x, y = xy[..., 0], xy[..., 1]
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    slopes = np.empty((*xy.shape, 5))
    powers = np.stack([r2, r2 * r2, r2 * r2 * r2], axis=-1)
    slopes[..., [0, 1, 4]] = xy[..., None] * powers[..., None, :]
    slopes[..., 0, 2] = slopes[..., 1, 3] = xy2
    slopes[..., 0, 3] = r2 + 2.0 * xx
    slopes[..., 1, 2] = r2 + 2.0 * yy
    return slopes


def _solve2(matrices: Array, vectors: Array) -> Array:
    """Solve 2x2 systems (..., 2, 2), (..., 2) by Cramer's rule."""
    (a, b), (c, d) = np.moveaxis(matrices, (-2, -1), (0, 1))
    u, v = vectors[..., 0], vectors[..., 1]
    return np.stack([d * u - b * v, a * v - c * u], axis=-1) / (a * d - b * c)[..., None]


def _numbers(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadInput(f"camera: {name} is not made of numbers: {error}") from None
    if array.shape != shape:
        raise BadInput(f"camera: {name} must have the shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise BadInput(f"camera: {name} holds a number that is not finite")
    return array


def _coefficients(value: Any) -> Array:
    count = np.size(value)
    if count not in (4, 5):
        raise BadInput(f"camera: distortion needs k1 k2 p1 p2 [k3], not {count} coefficients")
    array = _numbers(np.reshape(value, -1), "distortion", (count,))
    return np.append(array, np.zeros(5 - count))


def _size(value: Any) -> tuple[int, int]:
    sides = list(value) if isinstance(value, list | tuple) else []
    whole = all(isinstance(side, int) and not isinstance(side, bool) for side in sides)
    if len(sides) != 2 or not whole or min(sides) < 1:
        raise BadInput(f"camera: image_size must be [width, height] in pixels, not {value!r}")
    return sides[0], sides[1]


def _frozen(array: Array) -> Array:
    array.flags.writeable = False
    return array
