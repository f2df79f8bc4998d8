"""Where the camera sees each projector pixel on the table: homography and projector lens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.camera import coefficient_slopes, distort, distort_slopes, undistort
from cellctl.calib.homography import (
    apply_homography,
    direct_linear_transform,
    homography_jacobian,
)
from cellctl.calib.refinement import Refinement
from cellctl.errors import BadInput
from cellctl.geometry import Array

__all__ = [
    "ProjectorMap",
    "apply_homography",
    "direct_linear_transform",
    "homography_jacobian",
]


@dataclass(frozen=True, eq=False)
class ProjectorMap:
    """Undistorted normalised camera coordinates on the table <-> projector pixels, both ways.

    `H` (3, 3) leads to the pixels of a projector without distortion, with H[2, 2] = 1; `radial`
    (2,) k1, k2 then act about `centre` (2,) px at the focal length `focal_px`, as in a camera.
    From one plane focal length and pose of a projector cannot be told apart, so this map is all
    that a table shows: it is right on the table only. `bend`, where there is one, is what neither
    explains, a table's bow above all: from where homography and lens have the light of a pixel
    to where the camera sees it.
    """

    H: Array
    centre: Array
    focal_px: float
    radial: Array
    bend: Refinement | None = None

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
        plain = xy if self.bend is None else self.bend.undo(xy)
        ideal = apply_homography(self.H, plain)
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
        plain = apply_homography(np.linalg.inv(self.H), pixels)
        return plain if self.bend is None else self.bend.apply(plain)

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
        value: dict[str, Any] = {
            "H": self.H.tolist(),
            "centre_px": self.centre.tolist(),
            "focal_px": self.focal_px,
            "radial": self.radial.tolist(),
        }
        return value if self.bend is None else {**value, "bend": self.bend.to_dict()}

    @classmethod
    def from_dict(cls, value: Any, where: str = "projector") -> ProjectorMap:
        """Read `to_dict`'s form. BadInput says `where` and what is wrong."""
        try:
            return cls(
                value["H"],
                value["centre_px"],
                value["focal_px"],
                value["radial"],
                Refinement.from_dict(value["bend"], "bend") if "bend" in value else None,
            )
        except (KeyError, TypeError) as error:
            raise BadInput(
                f"{where}: needs H, centre_px, focal_px and radial ({error!r})"
            ) from None
        except BadInput as error:
            raise BadInput(f"{where}: {error.message}") from None


def _finite(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise BadInput(f"projector map: {name} is not made of numbers: {error}") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise BadInput(f"projector map: {name} must be finite and of the shape {shape}")
    array.flags.writeable = False
    return array
