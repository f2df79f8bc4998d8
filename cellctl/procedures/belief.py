"""Where the camera hangs and how a board is held, as far as that is known while searching.

Starts from the tape-measured poses with their uncertainty; every picture of the board, with the
pose that the robot reported, makes it better (maximum a posteriori, `calib.hand_eye.estimate`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.hand_eye_estimate import estimate
from cellctl.calib.targets import Board
from cellctl.calib.views import RobotView
from cellctl.geometry import Array, Transform, invert
from cellctl.procedures.rig import Rig

WELL_KNOWN_M = 0.02


@dataclass(frozen=True, eq=False)
class Belief:
    """`T_world_camera` and `T_flange_board` with one sigma of each, metres and radians."""

    camera: CameraModel
    T_world_camera: Transform
    T_flange_board: Transform
    camera_sigma: tuple[float, float]
    board_sigma: tuple[float, float]

    @property
    def enough_views(self) -> int:
        """How many views a search should find before a sweep is planned: enough for two axes of
        rotation where all is tape-measured, fewer where the camera's place is known."""
        return 6 if self.camera_sigma[0] > WELL_KNOWN_M else 3

    def updated(self, views: list[RobotView]) -> Belief:
        """With what `views` say; unchanged when there are none."""
        if not views:
            return self
        found = estimate(
            views,
            self.camera,
            self.T_world_camera,
            self.T_flange_board,
            camera_sigma=self.camera_sigma,
            board_sigma=self.board_sigma,
        )
        return replace(self, T_world_camera=found.camera_pose, T_flange_board=found.board_pose)

    def seen(self, view: RobotView) -> Array:
        """T_camera_board (4, 4) of a view, as it is believed."""
        board = view.T_base_flange.matrix @ self.T_flange_board.matrix
        return invert(self.T_world_camera.matrix) @ board

    def rig(self, board: Board) -> Rig:
        """For planning views of `board`."""
        low, high = board.extent()
        outline = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
        return Rig(self.camera, self.T_world_camera.matrix, self.T_flange_board.matrix, outline)
