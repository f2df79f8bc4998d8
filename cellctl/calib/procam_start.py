"""Where the adjustment of camera and projector begins: roughly right, from any captures.

The camera from its views of the board, as a pinhole; then the projector's whole projection matrix
from the board's points in the camera's frame, which captures in two planes fix. No guess of the
projector's principal point is needed, which lens shift puts outside its picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.linalg import rq

from cellctl.calib.camera import CameraModel
from cellctl.calib.pose import board_poses
from cellctl.calib.procam_problem import Capture, ProcamState
from cellctl.calib.views import View
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, transform_points

FOCAL_GUESSES = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
"""In longer sides of the picture, tried beside the closed form."""
NEGATIVE = (
    "the captures fit only a projector with a negative focal length: is its picture mirrored, or "
    "the order of the pictures another one than stated?"
)
FLAT = (
    "the captures do not fix the projector's focal length: hold the board at other distances, and "
    "tilted by 20 to 45 degrees in different ways"
)


def starts(
    captures: Sequence[Capture], image_size: tuple[int, int], size: tuple[int, int]
) -> list[ProcamState]:
    """Where to begin, one for each plausible focal length of the camera. SolveError when no
    pinhole camera and projector explain the captures, not even roughly."""
    found, why = [], FLAT
    for focal in _focal_lengths(captures, image_size):
        camera = _pinhole(focal, image_size)
        try:
            boards = [_pose(capture, camera) for capture in captures]
            projector, pose = _resected(captures, boards, size)
        except SolveError as error:
            why = error.message
            continue
        found.append(ProcamState(camera, projector, pose, np.stack(boards)))
    if not found:
        raise SolveError(why)
    return found


def _focal_lengths(captures: Sequence[Capture], image_size: tuple[int, int]) -> list[float]:
    """Zhang's, if noise or a bad capture leaves it sensible, and guesses."""
    guesses = [factor * max(image_size) for factor in FOCAL_GUESSES]
    points = [capture.points.astype(np.float32) for capture in captures]
    pixels = [capture.camera_px.astype(np.float32) for capture in captures]
    try:
        focal = float(cv2.initCameraMatrix2D(points, pixels, image_size, 1.0)[0, 0])
    except cv2.error:  # OpenCV finds no homography in single precision
        return guesses
    return [focal, *guesses] if 0.1 < focal / max(image_size) < 100.0 else guesses


def _pinhole(focal: float, image_size: tuple[int, int]) -> CameraModel:
    w, h = image_size
    K = np.array([[focal, 0.0, (w - 1) / 2], [0.0, focal, (h - 1) / 2], [0.0, 0.0, 1.0]])
    return CameraModel(K, np.zeros(5), image_size)


def _pose(capture: Capture, camera: CameraModel) -> Array:
    view = View(capture.id, capture.points, capture.camera_px)
    return board_poses(view, camera, refine=False)[0].matrix


def _resected(
    captures: Sequence[Capture], boards: Sequence[Array], size: tuple[int, int]
) -> tuple[CameraModel, Array]:
    """The projector and T_projector_camera (4, 4) from points in the camera's frame.

    Hartley and Zisserman, Multiple View Geometry, 2nd edition, algorithm 7.1 without its last
    step; skew is dropped.
    """
    points = np.concatenate(
        [transform_points(board, c.points) for board, c in zip(boards, captures, strict=True)]
    )
    pixels = np.concatenate([capture.projector_px for capture in captures])
    P = _projection_matrix(points, pixels)
    K, R = rq(P[:, :3])
    turn = np.diag(np.where(np.diag(K) < 0, -1.0, 1.0))
    K, R = K @ turn, turn @ R
    if abs(K[2, 2]) < 1e-12 * np.abs(K).max():
        raise SolveError(FLAT)
    if np.linalg.det(R) < 0:
        raise SolveError(NEGATIVE)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, np.linalg.solve(K, P[:, 3])
    K = K / K[2, 2]
    K[0, 1] = 0.0
    if not 0.05 < K[0, 0] / max(size) < 100.0 or not 0.2 < K[0, 0] / K[1, 1] < 5.0:
        raise SolveError(FLAT)
    try:
        return CameraModel(K, np.zeros(5), size), pose
    except BadInput as error:
        raise SolveError(f"{FLAT} ({error.message})") from None


def _projection_matrix(points: Array, pixels: Array) -> Array:
    """(3, 4) by the direct linear transform of normalised points, with points in front."""
    S, T = _normaliser(points), _normaliser(pixels)
    x = np.column_stack([transform_points(S, points), np.ones(len(points))])
    u = pixels @ T[:2, :2].T + T[:2, 2]
    zero = np.zeros_like(x)
    rows = np.concatenate([
        np.hstack([x, zero, -u[:, :1] * x]),
        np.hstack([zero, x, -u[:, 1:] * x]),
    ])  # fmt: skip
    values, right = np.linalg.svd(rows, full_matrices=False)[1:]
    if values[-2] < 1e-6 * values[0]:
        raise SolveError(FLAT)
    P = right[-1].reshape(3, 4)
    P = np.linalg.inv(T) @ P @ S
    in_front = np.median(points @ P[2, :3] + P[2, 3]) > 0
    return P if in_front else -P


def _normaliser(points: Array) -> Array:
    """Similarity (d + 1, d + 1) that moves points (n, d) about 0, at a distance of sqrt(d)."""
    d, centre = points.shape[1], points.mean(axis=0)
    scale = np.sqrt(d) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-300)
    matrix = np.diag([scale] * d + [1.0])
    matrix[:d, d] = -scale * centre
    return matrix
