"""The true lens of a simulated camera or projector: pinhole with Brown-Conrady distortion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Lens:
    """`focal`, `centre` (2,) in pixels; `distortion` (5,) k1 k2 p1 p2 k3; pixel centres at
    integers. Formula: https://docs.opencv.org, calib3d, "Detailed Description"."""

    size: tuple[int, int]
    focal: Array
    centre: Array
    distortion: Array

    @property
    def matrix(self) -> Array:
        """The camera matrix K (3, 3)."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the optical frame; float32 in, float32 out."""
        return self.pixels(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])

    def pixels(self, x: Array, y: Array) -> Array:
        """Pixels (..., 2) of normalised coordinates (...,) each."""
        (fx, fy), (cx, cy) = self.focal.tolist(), self.centre.tolist()
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([fx * u + cx, fy * v + cy], axis=-1)

    def rays(self, pixels: Array) -> Array:
        """Directions (..., 3) with z = 1 of pixels (..., 2), by fixed-point iteration."""
        flat = np.ascontiguousarray(pixels, dtype=float).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-12)
        eye = np.eye(3)
        xy = cv2.undistortPointsIter(flat, self.matrix, self.distortion, eye, eye, criteria)
        return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1).reshape(
            *pixels.shape[:-1], 3
        )
