"""A board and a wall under a projector's pictures, as a camera sees them: simple, and on purpose
nothing of the product's but geometry and the board's size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cellctl.calib.camera import CameraModel
from cellctl.calib.graycode import GrayCode
from cellctl.calib.targets import Chessboard
from cellctl.geometry import Array, invert, pose_matrix, transform_points

FINE = 2
BOARD = Chessboard((7, 5), 0.04)
CAMERA = CameraModel(
    np.array([[465.0, 0.0, 241.0], [0.0, 464.6, 177.0], [0.0, 0.0, 1.0]]),
    np.array([-0.08, 0.05, 0.0004, -0.0003, 0.0]),
    (480, 360),
)
PROJECTOR = CameraModel(
    np.array([[520.0, 0.0, 162.0], [0.0, 519.6, 262.0], [0.0, 0.0, 1.0]]),
    np.array([0.03, -0.02, -0.0003, 0.0004, 0.0]),
    (320, 240),
)
"""With lens shift: its principal point is below its picture."""
T_PROJECTOR_CAMERA = invert(pose_matrix((0.02, -0.2, 0.02), (0.16, 0.19, -0.06)))
INK, PAPER = 0.06, 0.85


def board_pose(turn: Any, middle: Any) -> Array:
    """T_camera_board (4, 4) with the middle of the board's corners at `middle`."""
    pose = pose_matrix(turn, (0.0, 0.0, 0.0))
    pose[:3, 3] = np.asarray(middle) - pose[:3, :3] @ BOARD.points.mean(axis=0)
    return pose


POSES = (
    board_pose((0.05, 0.02, 0.03), (0.0, 0.0, 0.74)),
    board_pose((0.45, 0.10, -0.1), (0.02, 0.01, 0.70)),
    board_pose((-0.15, -0.5, 0.1), (-0.02, -0.01, 0.78)),
    board_pose((-0.4, 0.35, 0.05), (0.01, 0.02, 0.66)),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """`pose` T_camera_board of the sheet; a wall stands `wall` metres behind the camera's zero,
    black if None. `exposure` is the grey level of white on full light, `ambient` that of no
    light, `noise` in grey levels; `shade` (x0, y0, x1, y1) projector pixels do not arrive."""

    pose: Array
    wall: float | None = 1.0
    exposure: float = 190.0
    ambient: float = 8.0
    noise: float = 1.5
    shade: tuple[int, int, int, int] | None = None
    slope: float = 0.0
    camera: CameraModel = CAMERA
    projector: CameraModel = PROJECTOR
    T_projector_camera: Array = field(default_factory=lambda: T_PROJECTOR_CAMERA)

    def without(self, **changes: Any) -> Scene:
        return replace(self, **changes)

    def pictures(self, code: GrayCode, seed: int = 0) -> list[NDArray[np.uint8]]:
        """Of all slides of a code."""
        albedo, places = self._surfaces()
        near = np.rint(np.nan_to_num(places, nan=-9.0)).astype(np.int64)
        width, height = code.size
        lit = ((near >= 0) & (near < (width, height))).all(axis=-1)
        if self.shade is not None:
            x0, y0, x1, y1 = self.shade
            lit &= ~((near >= (x0, y0)) & (near < (x1, y1))).all(axis=-1)
        albedo = (albedo * lit * self.exposure).astype(np.float32)
        column, row = np.clip(near[..., 0], 0, width - 1), np.clip(near[..., 1], 0, height - 1)
        rng = np.random.default_rng(seed)
        images = []
        for slide in code.slides:
            shown = code.picture(slide)
            light = shown[:, 0][row] if slide.shows == "row" else shown[0][column]
            images.append(self._exposed(albedo * (light > 0), rng))
        return images

    def truth(self, pixels: Array) -> Array:
        """Projector pixels (n, 2) of camera pixels (n, 2) on the board."""
        rays = np.column_stack([self.camera.normalise(pixels), np.ones(len(pixels))])
        return self._shown(rays * _depths(rays, self.pose)[:, None])

    def _shown(self, points: Array) -> Array:
        return self.projector.project(transform_points(self.T_projector_camera, points))

    def _surfaces(self) -> tuple[Array, Array]:
        """At FINE x FINE samples a pixel: reflectance (h, w), and projector pixels (h, w, 2)."""
        w, h = self.camera.image_size
        x, y = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (w, h))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        rays = np.column_stack([self.camera.normalise(pixels), np.ones(len(pixels))])
        depth = _depths(rays, self.pose)
        on_board = transform_points(invert(self.pose), rays * depth[:, None])[:, :2]
        low, high = BOARD.extent()
        inside = ((on_board > low - 0.02) & (on_board < high + 0.02)).all(axis=1) & (depth > 0)
        printed = ((on_board > low) & (on_board < high)).all(axis=1)
        dark = printed & (np.floor(on_board / BOARD.square_m).sum(axis=1) % 2 == 0)
        albedo = np.where(dark, INK, PAPER)
        if self.wall is None:
            albedo = np.where(inside, albedo, 0.0)
        else:
            depth = np.where(inside, depth, self.wall + self.slope * rays[:, 0])
            albedo = np.where(inside, albedo, 0.6)
        shape = (h * FINE, w * FINE)
        return albedo.reshape(shape), self._shown(rays * depth[:, None]).reshape(*shape, 2)

    def _exposed(self, fine: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        small = cv2.resize(fine, self.camera.image_size, interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(small, (0, 0), 0.6) + np.float32(self.ambient)
        image += np.float32(self.noise) * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _depths(rays: Array, pose: Array) -> Array:
    """How far along rays (n, 3) the plane z = 0 of a pose is."""
    normal = pose[:3, 2]
    return np.asarray((normal @ pose[:3, 3]) / (rays @ normal))


def scenes(poses: Iterable[Array] = POSES) -> list[Scene]:
    return [Scene(pose) for pose in poses]
