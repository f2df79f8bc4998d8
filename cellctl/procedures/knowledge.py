"""What is known of the cell before a procedure starts: from the active calibration, from an
earlier part of the same run, or else from factory values and the tape measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.projector import LensPrior
from cellctl.calib.targets import Board, board_from_dict
from cellctl.config import BoardMount, CellConfig
from cellctl.geometry import Transform
from cellctl.procedures.belief import Belief

CALIBRATED_SIGMA = (0.005, np.radians(0.5))
"""Of a pose that was calibrated before, metres and radians: bracket and camera may have been
taken off and put back since."""


@dataclass(frozen=True, eq=False)
class Knowledge:
    """`camera` and `T_world_camera` as far as known; `calibrated` says whether both come from a
    calibration. `boards` are the poses T_flange_<board> that a calibration knows."""

    camera: CameraModel
    T_world_camera: Transform
    calibrated: bool
    boards: Mapping[str, Transform]

    def belief(self, config: CellConfig, board: str) -> Belief:
        """What to start a search for `board` with."""
        tape = (config.tape.position_m, float(np.radians(config.tape.angle_deg)))
        mount = mount_of(config, board)
        known = self.boards.get(board)
        return Belief(
            camera=self.camera,
            T_world_camera=self.T_world_camera,
            T_flange_board=known or mount.pose.transform("flange", board),
            camera_sigma=CALIBRATED_SIGMA if self.calibrated else tape,
            board_sigma=CALIBRATED_SIGMA if known else tape,
        )


def known(config: CellConfig, active: Mapping[str, Any] | None) -> Knowledge:
    """From the active calibration's document, or from config alone when there is none."""
    if active is None:
        return Knowledge(
            factory_camera(config),
            config.camera.pose.transform("world", "camera"),
            calibrated=False,
            boards={},
        )
    calibration = Calibration.from_dict(active, "active calibration")
    return Knowledge(
        calibration.camera, calibration.T_world_camera, calibrated=True, boards=calibration.boards
    )


def factory_camera(config: CellConfig) -> CameraModel:
    """The maker's intrinsics."""
    factory = config.camera.factory
    (fx, fy), (cx, cy) = factory.focal_px, factory.centre_px
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CameraModel(K, np.array(factory.distortion), config.camera.image_size_px)


def mount_of(config: CellConfig, board: str) -> BoardMount:
    """The bracket's mount of `checkerboard` or `markers`."""
    return config.bracket.checkerboard if board == "checkerboard" else config.bracket.markers


def board_of(config: CellConfig, board: str) -> Board:
    return board_from_dict(mount_of(config, board).board, f"bracket.{board}.board")


def lens_prior(config: CellConfig) -> LensPrior:
    """What the projector's data sheet says of its lens."""
    projector = config.projector
    focal = projector.throw_ratio * projector.size_px[0]
    return LensPrior(focal, np.array(projector.centre_px))


def table_plane(config: CellConfig) -> Plane:
    """The table as the robot knows it from touching it: level, at the touched height."""
    return Plane.horizontal(config.table.touched_height_m)
