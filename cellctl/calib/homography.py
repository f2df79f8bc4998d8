"""Homographies: applied, differentiated, fitted."""

from __future__ import annotations

import numpy as np

from cellctl.geometry import Array


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
