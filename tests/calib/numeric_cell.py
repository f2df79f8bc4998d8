"""The simulated cell without pictures: true geometry, and corners with Gaussian noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl import ik
from cellctl.calib.camera import CameraModel
from cellctl.calib.patterns import marker_pictures
from cellctl.calib.targets import ArucoGrid, Chessboard
from cellctl.calib.views import RobotView
from cellctl.geometry import Array, Transform, invert, pose_matrix
from cellctl.sim.cell_config import cell_document
from cellctl.sim.grid import Grid
from cellctl.sim.presets import CR, Preset
from cellctl.sim.truth import Rng, Truth, draw

CORNER_NOISE_PX = 0.07
HOME = np.radians([-90.0, -110.0, 110.0, -90.0, -90.0, 0.0])
"""Of the solutions of inverse kinematics the one nearest to here is taken."""


@dataclass(frozen=True, eq=False)
class NumericCell:
    """What a full run would collect: 30 intrinsic views, 10 hand-eye views, 4 marker pictures."""

    truth: Truth
    intrinsic: list[RobotView]
    hand_eye: list[RobotView]
    pictures: list[dict[int, Array]]
    centres: dict[int, Array]
    factory: CameraModel
    known: Grid

    def score(self, pixels: Array) -> dict[str, float]:
        """true_mm and true_px of the pixels (121, 2) sent for `grid`."""
        return self.known.score(pixels, self.truth)

    @property
    def table_height(self) -> float:
        return self.known.height

    @property
    def grid(self) -> Array:
        """The world points (121, 3) that are scored, at the height that the robot knows."""
        return self.known.points


Poser = Callable[[Truth, str, int, Rng], list[Array]]
"""Joints (6,) of the nominal arm that show the board of that name, so many or more of them."""


def random_poses(truth: Truth, name: str, count: int, rng: Rng) -> list[Array]:
    """Anywhere in the CR's picture."""
    wanted = _board_poses(truth, name, 4 * count, rng)
    return _reachable(truth, wanted @ invert(truth.boards[name].pose.matrix))


def numeric_cell(
    seed: int,
    intrinsic: int = 30,
    hand_eye: int = 10,
    preset: Preset = CR,
    poser: Poser = random_poses,
) -> NumericCell:
    truth = draw(preset, seed)
    rng = np.random.default_rng([seed, 99])
    pictures = marker_pictures(truth.projector.lens.size)
    sizes = preset.boards
    checkerboard = Chessboard(sizes.inner_corners, sizes.square_m)
    markers = ArucoGrid(sizes.markers, sizes.marker_m, sizes.pitch_m, sizes.dictionary)
    return NumericCell(
        truth=truth,
        intrinsic=_views(truth, "checkerboard", checkerboard.points, intrinsic, poser, rng),
        hand_eye=_views(truth, "markers", markers.points, hand_eye, poser, rng),
        pictures=[_seen(truth, picture.centres, rng) for picture in pictures],
        centres={i: c for picture in pictures for i, c in picture.centres.items()},
        factory=_factory(preset, seed),
        known=Grid(truth),
    )


def _factory(preset: Preset, seed: int) -> CameraModel:
    """The maker's values, as the simulated cell's config has them."""
    camera = cell_document(preset, seed)["camera"]
    (fx, fy), (cx, cy) = camera["factory"]["focal_px"], camera["factory"]["centre_px"]
    vector = np.array([fx, fy, cx, cy, *camera["factory"]["distortion"]])
    return CameraModel.from_vector(vector, tuple(camera["image_size_px"]))


def _views(
    truth: Truth, name: str, points: Array, count: int, poser: Poser, rng: Rng
) -> list[RobotView]:
    views: list[RobotView] = []
    while len(views) < count:
        for joints in poser(truth, name, count, rng):
            pixels = _picture(truth, name, points[:, :2], joints, rng)
            if pixels is not None and len(views) < count:
                reported = Transform("world", "flange", truth.nominal_arm.forward(joints))
                views.append(RobotView(f"{len(views):02d}", points, pixels, reported))
    return views


def _board_poses(truth: Truth, name: str, count: int, rng: Rng) -> Array:
    """Boards that face the camera, tilted by 20-45 degrees, at several heights and places."""
    board = truth.boards[name]
    lens, (w, h) = truth.camera.lens, truth.camera.lens.size
    poses = []
    for _ in range(count):
        ray = lens.rays(rng.uniform((0.1 * w, 0.1 * h), (0.9 * w, 0.9 * h)))
        tilt, about = np.radians(rng.uniform(20, 45)), rng.uniform(0, 2 * np.pi)
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        turn = turn * Rotation.from_rotvec([0, 0, rng.uniform(-np.pi / 3, np.pi / 3)])
        pose = pose_matrix(turn.as_rotvec(), ray * rng.uniform(0.4, 0.65))
        pose[:3, 3] -= pose[:3, :3] @ (*board.centre, 0.0)
        poses.append(truth.camera.pose.matrix @ pose)
    return np.array(poses)


def _reachable(truth: Truth, flanges: Array) -> list[Array]:
    starts = np.vstack([HOME, ik.random_starts(truth.nominal_arm, 6, 0)])
    found = ik.solutions(truth.nominal_arm, flanges, HOME, starts)
    return [joints[0] for joints in found if len(joints)]


def _picture(truth: Truth, name: str, nominal: Array, joints: Array, rng: Rng) -> Array | None:
    """Noisy pixels (n, 2) of the true board, or None when it is not wholly in the picture."""
    errors, board = truth.preset.arm_errors, truth.boards[name]
    turn = rng.normal(0.0, np.radians(errors.repeat_sigma_deg), 3)
    repeat = pose_matrix(turn, rng.normal(0.0, errors.repeat_sigma_m, 3))
    pose = truth.arm.forward(joints) @ repeat @ board.pose.matrix
    world = Transform("world", "board", pose).apply(board.surface(nominal))
    pixels = truth.camera.project(world)
    inside = np.all((pixels > 15) & (pixels < np.array(truth.camera.lens.size) - 15))
    return pixels + rng.normal(0.0, CORNER_NOISE_PX, pixels.shape) if inside else None


def _seen(truth: Truth, centres: dict[int, Array], rng: Rng) -> dict[int, Array]:
    ids = sorted(centres)
    world = truth.light_lands(np.array([centres[i] for i in ids]))
    pixels = truth.camera.project(world)
    noisy = pixels + rng.normal(0.0, CORNER_NOISE_PX / 2, pixels.shape)
    inside = np.all((noisy > 5) & (noisy < np.array(truth.camera.lens.size) - 5), axis=1)
    return {i: p for i, p, ok in zip(ids, noisy, inside, strict=True) if ok}
