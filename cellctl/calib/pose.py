"""Poses of boards, and the small calculus of rotations that the adjustments need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.views import View, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, pose_matrix, transform_points


def pose_matrices(vectors: Array) -> Array:
    """(n, 4, 4) from (n, 6): rotation vectors in radians, then translations (Rodrigues)."""
    turns = vectors[:, :3]
    angles = np.linalg.norm(turns, axis=1)[:, None, None]
    crosses = cross_matrices(turns)
    matrices = np.zeros((len(vectors), 4, 4))
    matrices[:, :3, :3] = np.eye(3) + np.sinc(angles / np.pi) * crosses
    matrices[:, :3, :3] += 0.5 * np.sinc(angles / (2.0 * np.pi)) ** 2 * crosses @ crosses
    matrices[:, :3, 3] = vectors[:, 3:]
    matrices[:, 3, 3] = 1.0
    return matrices


def pose_vectors(matrices: Array) -> Array:
    """(n, 6) of (n, 4, 4): rotation vectors in radians, then translations.

    For rotations that are not close to half a turn: the corrections and priors of adjustments.
    """
    R = matrices[:, :3, :3]
    axes = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sines = np.linalg.norm(axes, axis=1)
    angles = np.arctan2(sines, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    factors = np.where(sines > 1e-12, angles / np.maximum(sines, 1e-12), 1.0)
    return np.concatenate([factors[:, None] * axes, matrices[:, :3, 3]], axis=1)


def cross_matrices(vectors: Array) -> Array:
    """(n, 3, 3) matrices [v]x with [v]x w = v x w, of (n, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, [2, 0, 1], [1, 2, 0]] = vectors
    matrices[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return matrices


def adjoint(matrix: Array) -> Array:
    """(6, 6) of a pose (4, 4) T: T pose(d) T^-1 = pose(adjoint @ d), to first order in d."""
    R, t = matrix[:3, :3], matrix[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = R
    result[3:, :3] = cross_matrices(t[None])[0] @ R
    return result


def derivatives_by_pose(by_point: Array, points: Array) -> Array:
    """(..., 2, 6): derivatives by d when the pose T that maps `points` (..., 3) becomes
    T @ pose(d), d a rotation vector and a translation, from the derivatives (..., 2, 3) by the
    points before T: g (w x p + v) = (p x g) w + g v."""
    gx, gy, gz = by_point[..., 0], by_point[..., 1], by_point[..., 2]
    px, py, pz = (points[..., None, i] for i in range(3))
    result = np.empty((*by_point.shape[:-1], 6))
    result[..., 0] = py * gz - pz * gy
    result[..., 1] = pz * gx - px * gz
    result[..., 2] = px * gy - py * gx
    result[..., 3:] = by_point
    return result


def pose_vector_derivatives(matrices: Array) -> Array:
    """(n, 6, 6): how `pose_vectors` changes when (n, 4, 4) T becomes T @ pose(d), by d.

    The rotation's block is the inverse of the right Jacobian of SO(3): G. S. Chirikjian,
    Stochastic Models, Information Theory, and Lie Groups 2, 2012, section 10.3.
    """
    turns = pose_vectors(matrices)[:, :3]
    angles = np.maximum(np.linalg.norm(turns, axis=1), 1e-6)
    factors = 1.0 / angles**2 - 0.5 / (angles * np.tan(0.5 * angles))
    crosses = cross_matrices(turns)
    result = np.zeros((len(matrices), 6, 6))
    result[:, :3, :3] = np.eye(3) + 0.5 * crosses + factors[:, None, None] * crosses @ crosses
    result[:, 3:, 3:] = matrices[:, :3, :3]
    return result


@dataclass(frozen=True, eq=False)
class BoardPose:
    """T_camera_board (4, 4) of one view, and its reprojection error."""

    matrix: Array
    rms_px: float


def board_pose(view: View, camera: CameraModel) -> BoardPose:
    """The board's pose that explains a view best. SolveError when its points lie on a line."""
    return board_poses(view, camera)[0]


def board_poses(view: View, camera: CameraModel, *, refine: bool = True) -> list[BoardPose]:
    """Both poses of a plane that its picture allows, the better one first; in closed form, or
    refined to the least reprojection error.

    From far away the picture of a tilted board hardly changes when the tilt is mirrored, and
    the worse of the two may be the true one: T. Collins, A. Bartoli, Infinitesimal plane-based
    pose estimation, 2014. SolveError when the points lie on a line.
    """
    normalised = camera.normalise(view.pixels)
    if not np.isfinite(normalised).all() or on_a_line(view.points):
        raise SolveError(f"view {view.id!r}: its {len(view.points)} points do not fix a pose")
    _, turns, shifts, _ = cv2.solvePnPGeneric(
        view.points, normalised, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    starts = zip(turns, shifts, strict=True)
    poses = [_pose(view, camera, *(_refined(view, camera, *s) if refine else s)) for s in starts]
    sound = [pose for pose in poses if np.isfinite(pose.rms_px)]
    if not sound:
        raise SolveError(f"view {view.id!r}: no pose in front of the camera explains it")
    return sorted(sound, key=lambda pose: pose.rms_px)


def _refined(view: View, camera: CameraModel, turn: Any, shift: Any) -> tuple[Any, Any]:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-12)
    return cv2.solvePnPRefineLM(
        view.points, view.pixels, camera.K, camera.distortion, turn, shift, criteria
    )


def _pose(view: View, camera: CameraModel, turn: Any, shift: Any) -> BoardPose:
    matrix = pose_matrix(turn, shift)
    errors = camera.project(transform_points(matrix, view.points)) - view.pixels
    return BoardPose(matrix, rms(errors))


def on_a_line(points: Array) -> bool:
    """Whether board points (n, 3) do not span the board."""
    spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
    return len(points) < 4 or spread[1] < 1e-3 * spread[0]
