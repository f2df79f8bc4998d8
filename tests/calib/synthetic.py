"""Views of boards from a known truth: no pictures, corners with Gaussian noise."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl.calib.camera import CameraModel
from cellctl.calib.hand_eye_fit import Mount
from cellctl.calib.targets import Chessboard
from cellctl.calib.views import RobotView, View
from cellctl.geometry import Array, Transform, invert, pose_matrix, transform_points

CAMERA = CameraModel(
    np.array([[915.0, 0.0, 958.0], [0.0, 914.0, 548.0], [0.0, 0.0, 1.0]]),
    np.array([0.085, -0.060, 0.0005, -0.0004, 0.012]),
    (1920, 1080),
)
BOARD = Chessboard((9, 6), 0.03)
X = pose_matrix((2.9, 0.2, -0.1), (0.05, -0.5, 0.8))
"""Camera on its anchor."""
Y = pose_matrix((0.1, -0.2, 1.4), (0.12, -0.05, 0.03))
"""Board on its mount."""


def board_poses(rng: np.random.Generator, count: int, tilt_deg: tuple[float, float]) -> Array:
    """T_camera_board (n, 4, 4) all over the picture, tilted by `tilt_deg`, turned by +-60."""
    middle = np.append(BOARD.points[:, :2].mean(axis=0), 0.0)
    poses = []
    for _ in range(count):
        tilt, about = np.radians(rng.uniform(*tilt_deg)), rng.uniform(0, 2 * np.pi)
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        turn = turn * Rotation.from_rotvec([0, 0, rng.uniform(-np.pi / 3, np.pi / 3)])
        ray = np.append(rng.uniform((-0.5, -0.25), (0.5, 0.25)), 1.0)
        pose = pose_matrix(turn.as_rotvec(), ray * rng.uniform(0.4, 0.7))
        pose[:3, 3] -= pose[:3, :3] @ middle
        poses.append(pose)
    return np.array(poses)


def pixels(
    pose: Array, rng: np.random.Generator, noise: float, points: Array = BOARD.points
) -> Array:
    return CAMERA.project(transform_points(pose, points)) + rng.normal(0, noise, (len(points), 2))


def views(
    seed: int,
    count: int = 15,
    noise: float = 0.1,
    tilt_deg: tuple[float, float] = (15.0, 45.0),
    points: Array = BOARD.points,
) -> list[View]:
    """`points` are where the corners truly are; the views claim that the board is flat."""
    rng = np.random.default_rng(seed)
    poses = board_poses(rng, count, tilt_deg)
    return [
        View(f"v{i:02d}", BOARD.points, pixels(pose, rng, noise, points))
        for i, pose in enumerate(poses)
    ]


def robot_views(
    seed: int,
    mount: Mount = "eye-to-hand",
    count: int = 12,
    *,
    noise: float = 0.1,
    robot: tuple[float, float] = (0.0, 0.0),
    scale: float = 1.0,
    tilt_deg: tuple[float, float] = (15.0, 45.0),
) -> list[RobotView]:
    """Views with reported poses; `robot` is their noise in metres and degrees."""
    rng = np.random.default_rng(seed)
    found = []
    for i, pose in enumerate(board_poses(rng, count, tilt_deg)):
        chain = X @ pose @ invert(Y)  # T_base_flange, or its inverse eye-in-hand
        true = chain if mount == "eye-to-hand" else invert(chain)
        turn, shift = rng.normal(0, np.radians(robot[1]), 3), rng.normal(0, robot[0], 3)
        reported = Transform("base", "flange", true @ pose_matrix(turn, shift))
        seen = pixels(pose, rng, noise, BOARD.points * scale)
        found.append(RobotView(f"v{i:02d}", BOARD.points, seen, reported))
    return found
