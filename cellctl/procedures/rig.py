"""What planning works on: a camera, how a board is held before it, and planned views of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.geometry import Array, invert


@dataclass(frozen=True, eq=False)
class Rig:
    """What planning assumes: the camera, where it hangs, and how the board is held.

    `T_world_camera` and `T_flange_board` (4, 4) are estimates; `outline` (4, 2) are the corners
    of the board's printed area in board metres.
    """

    camera: CameraModel
    T_world_camera: Array
    T_flange_board: Array
    outline: Array

    def flange(self, T_camera_board: Array) -> Array:
        """T_world_flange (n, 4, 4) that shows the board at T_camera_board (n, 4, 4)."""
        return self.T_world_camera @ T_camera_board @ invert(self.T_flange_board)

    def board_points(self, T_camera_board: Array, grid: int = 2) -> Array:
        """Points (n, grid^2, 3) of the board in the camera frame."""
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        x, y = (np.linspace(a, b, grid) for a, b in zip(low, high, strict=True))
        flat = np.stack([*np.meshgrid(x, y), np.zeros((grid, grid))], axis=-1).reshape(-1, 3)
        turned = np.einsum("nij,mj->nmi", T_camera_board[:, :3, :3], flat)
        return turned + T_camera_board[:, None, :3, 3]


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A planned view: how the camera will see the board, and the joints (6,) that show it."""

    T_camera_board: Array
    joints: Array
