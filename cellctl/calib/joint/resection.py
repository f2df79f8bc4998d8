"""A projector from where its light landed, roughly: the start of its adjustment."""

from __future__ import annotations

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.joint.problem import LensPrior
from cellctl.calib.joint.state import FullProjector
from cellctl.errors import SolveError
from cellctl.geometry import Array, invert, pose_matrix

LEAST = 12


def resection(points: Array, pixels: Array, lens: LensPrior | None) -> FullProjector:
    """From world points (n, 3) off one plane and the projector pixels (n, 2) that light them.

    With the data sheet's lens by PnP, without it by the direct linear transform (Hartley and
    Zisserman, Multiple View Geometry, 2nd edition, 7.1). SolveError when neither works.
    """
    if len(points) < LEAST:
        raise SolveError(f"light was seen at {len(points)} points, {LEAST} are needed")
    size = (int(pixels[:, 0].max()) + 1, int(pixels[:, 1].max()) + 1)
    found = _linear(points, pixels) if lens is None else _with_lens(points, pixels, lens)
    K, pose = found
    full = FullProjector(CameraModel(K, np.zeros(5), size), pose)
    if not np.isfinite(full.project(points)).all():
        raise SolveError("no projector explains where its light landed: is its picture mirrored?")
    return full


def _with_lens(points: Array, pixels: Array, lens: LensPrior) -> tuple[Array, Array]:
    focal = lens.focal
    K = np.array([[focal, 0.0, lens.centre[0]], [0.0, focal, lens.centre[1]], [0.0, 0.0, 1.0]])
    ok, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        raise SolveError("no pose of the projector explains where its light landed")
    return K, invert(pose_matrix(turn, shift))


def _linear(points: Array, pixels: Array) -> tuple[Array, Array]:
    middle, spread = points.mean(axis=0), points.std()
    centre, size = pixels.mean(axis=0), pixels.std()
    p = np.column_stack([(points - middle) / spread, np.ones(len(points))])
    x, y = ((pixels - centre) / size).T[..., None]
    zero = np.zeros_like(p)
    rows = np.concatenate([np.hstack([p, zero, -x * p]), np.hstack([zero, p, -y * p])])
    P = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
    to_pixels = np.array([[size, 0.0, centre[0]], [0.0, size, centre[1]], [0.0, 0.0, 1.0]])
    to_scaled = np.diag([1 / spread, 1 / spread, 1 / spread, 1.0])
    to_scaled[:3, 3] = -middle / spread
    P = to_pixels @ P @ to_scaled
    P = P * np.sign(np.linalg.det(P[:, :3]))
    K, R = cv2.RQDecomp3x3(P[:, :3])[1:3]
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    pose = np.eye(4)
    pose[:3, :3] = R.T
    pose[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
    focal = np.sqrt(K[0, 0] * K[1, 1]) / K[2, 2]
    K = np.array([[focal, 0.0, K[0, 2] / K[2, 2]], [0.0, focal, K[1, 2] / K[2, 2]], [0, 0, 1]])
    return K, pose
