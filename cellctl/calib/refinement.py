"""A correction of a calibration in the camera's plane, as circles that were drawn ask for it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cellctl.calib.homography import apply_homography
from cellctl.errors import BadInput
from cellctl.geometry import Array

FAMILIES = (
    "none",
    "shift",
    "similarity",
    "joint",
    "affine",
    "projective",
    "challenger",
    "quadratic",
    "rbf",
    "thin-plate",
    "cubic",
)
"""From the simplest to the least simple."""
KERNELS = ("none", "rbf", "thin-plate")
NEWTON_STEPS = 30


@dataclass(frozen=True, eq=False)
class Refinement:
    """Undistorted normalised camera coordinates as a calibration has them -> as they are seen.

    With u = (xy - centre) / scale the map is

        u -> H u + sum_j polynomial_j u^powers_j + sum_k weights_k phi(|u - node_k|),

    H (3, 3) with H[2, 2] = 1 taken projectively; `polynomial` (m, 2) are the coefficients of the
    monomials of second, or second and third, degree in the order of `powers`; phi is
    r^2 log r ("thin-plate") or exp(-r^2 / 2 length^2) ("rbf") about `nodes` (k, 2). Coordinates
    are centred and scaled because powers of raw ones are nearly collinear.
    """

    family: str
    centre: Array = field(default_factory=lambda: np.zeros(2))
    scale: float = 1.0
    H: Array = field(default_factory=lambda: np.eye(3))
    polynomial: Array = field(default_factory=lambda: np.zeros((0, 2)))
    kernel: str = "none"
    length: float = 1.0
    nodes: Array = field(default_factory=lambda: np.zeros((0, 2)))
    weights: Array = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        shapes = {"centre": (2,), "H": (3, 3), "polynomial": (-1, 2), "nodes": (-1, 2)}
        for name, shape in {**shapes, "weights": (-1, 2), "scale": (), "length": ()}.items():
            object.__setattr__(self, name, _finite(getattr(self, name), name, shape))
        for name in ("scale", "length"):
            object.__setattr__(self, name, float(getattr(self, name)))
        self._check()

    def _check(self) -> None:
        if self.family not in FAMILIES:
            raise BadInput(
                f"refinement: no family is called {self.family!r}: {', '.join(FAMILIES)}"
            )
        if self.kernel not in KERNELS:
            raise BadInput(f"refinement: no kernel is called {self.kernel!r}: {', '.join(KERNELS)}")
        if self.scale <= 0 or self.length <= 0 or abs(np.linalg.det(self.H)) < 1e-12:
            raise BadInput("refinement: scale and length must be positive and H invertible")
        if len(self.polynomial) not in (0, 3, 7):
            raise BadInput(f"refinement: polynomial has {len(self.polynomial)} rows, not 0, 3 or 7")
        if len(self.nodes) != len(self.weights):
            raise BadInput("refinement: nodes and weights must be equally many")

    def scaled(self, xy: Array) -> Array:
        """u (n, 2) of camera coordinates (n, 2)."""
        return (np.asarray(xy, dtype=float) - self.centre) / self.scale

    def apply(self, xy: Array) -> Array:
        """Camera coordinates (n, 2) where a point is seen, of those (n, 2) of the calibration."""
        if self.family == "none":
            return np.asarray(xy, dtype=float)
        return self._map(self.scaled(xy)) * self.scale + self.centre

    def undo(self, xy: Array) -> Array:
        """Inverse of `apply`, to rounding; not-a-number where Newton's iteration finds none."""
        if self.family == "none":
            return np.asarray(xy, dtype=float)
        target = self.scaled(xy)
        u = apply_homography(np.linalg.inv(self.H), target)
        for _ in range(NEWTON_STEPS if len(self.polynomial) or len(self.nodes) else 0):
            step = np.linalg.solve(self.slopes(u), (target - self._map(u))[..., None])[..., 0]
            u = u + step
            if not np.any(np.abs(step) > 1e-15 * (1.0 + np.abs(u))):
                break
        off = np.abs(self._map(u) - target).max(axis=-1)
        u[~(off < 1e-10 * (1.0 + np.abs(target).max(axis=-1)))] = np.nan
        return u * self.scale + self.centre

    def _map(self, u: Array) -> Array:
        moved = apply_homography(self.H, u)
        if len(self.polynomial):
            moved = moved + monomials(u, len(self.polynomial)) @ self.polynomial
        if len(self.nodes):
            moved = moved + kernel_values(self.kernel, self.length, u, self.nodes) @ self.weights
        return moved

    def slopes(self, u: Array) -> Array:
        """Derivatives (n, 2, 2) of the map by u (n, 2); the same for `apply` by xy."""
        slopes = homography_slopes(self.H, u)
        if count := len(self.polynomial):
            slopes = slopes + np.einsum("njd,jc->ncd", monomial_slopes(u, count), self.polynomial)
        if len(self.nodes):
            by_u = kernel_slopes(self.kernel, self.length, u, self.nodes)
            slopes = slopes + np.einsum("nkd,kc->ncd", by_u, self.weights)
        return slopes

    def to_dict(self) -> dict[str, Any]:
        """JSON form; floats survive exactly."""
        return {
            "family": self.family,
            "centre": self.centre.tolist(),
            "scale": self.scale,
            "H": self.H.tolist(),
            "polynomial": self.polynomial.tolist(),
            "kernel": self.kernel,
            "length": self.length,
            "nodes": self.nodes.tolist(),
            "weights": self.weights.tolist(),
        }

    @classmethod
    def from_dict(cls, value: Any, where: str = "refinement") -> Refinement:
        """Read `to_dict`'s form. BadInput says `where` and what is wrong."""
        names = cls.__dataclass_fields__
        if not isinstance(value, dict) or set(value) != set(names):
            raise BadInput(f"{where}: needs exactly {', '.join(names)}")
        try:
            return cls(**value)
        except BadInput as error:
            raise BadInput(f"{where}: {error.message.removeprefix('refinement: ')}") from None


POWERS = np.array([(2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)])
"""Of u and v, for the rows of `Refinement.polynomial`."""


def monomials(u: Array, count: int) -> Array:
    """The first `count` monomials of POWERS (n, count) at u (n, 2)."""
    p, q = POWERS[:count].T
    return u[:, :1] ** p * u[:, 1:] ** q


def monomial_slopes(u: Array, count: int) -> Array:
    """Derivatives (n, count, 2) of `monomials` by u."""
    p, q = POWERS[:count].T
    x, y = u[:, :1], u[:, 1:]
    by_x = p * x ** np.maximum(p - 1, 0) * y**q
    by_y = q * x**p * y ** np.maximum(q - 1, 0)
    return np.stack([by_x, by_y], axis=-1)


def kernel_values(kernel: str, length: float, u: Array, nodes: Array) -> Array:
    """phi (n, k) of the distances from u (n, 2) to nodes (k, 2)."""
    r2 = np.square(u[:, None] - nodes).sum(axis=-1)
    if kernel == "thin-plate":
        return 0.5 * r2 * np.log(np.maximum(r2, 1e-300))
    return np.exp(-0.5 * r2 / length**2)


def kernel_slopes(kernel: str, length: float, u: Array, nodes: Array) -> Array:
    """Derivatives (n, k, 2) of `kernel_values` by u."""
    away = u[:, None] - nodes
    r2 = np.square(away).sum(axis=-1, keepdims=True)
    if kernel == "thin-plate":
        return away * (np.log(np.maximum(r2, 1e-300)) + 1.0)
    return -away / length**2 * np.exp(-0.5 * r2 / length**2)


def homography_slopes(H: Array, points: Array) -> Array:
    """Derivatives (n, 2, 2) of `apply_homography` by points (n, 2)."""
    mapped = apply_homography(H, points)
    w = points @ H[2, :2] + H[2, 2]
    return (H[:2, :2] - mapped[:, :, None] * H[2, :2]) / w[:, None, None]


def _finite(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=float)
        if shape[:1] == (-1,):
            array = array.reshape(-1, 2) if array.size == 0 else array
    except (TypeError, ValueError) as error:
        raise BadInput(f"refinement: {name} is not made of numbers: {error}") from None
    fits = array.ndim == len(shape) and all(
        b in (-1, a) for a, b in zip(array.shape, shape, strict=True)
    )
    if not fits or not np.isfinite(array).all():
        wanted = str(shape).replace("-1", "n")
        raise BadInput(f"refinement: {name} must be finite and of the shape {wanted}")
    array.flags.writeable = False
    return array
