"""The table of the published pipeline, stage by stage: the same data solved again with the later
stages at their baselines. A row is a `Calibration` like any other, so the table is a loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.closed_form import closed_form
from cellctl.calib.hand_eye import solve_hand_eye
from cellctl.calib.hand_eye_result import HandEyeResult
from cellctl.calib.intrinsic import IntrinsicResult, solve_intrinsic
from cellctl.calib.pose import board_pose
from cellctl.calib.projector import LensPrior, ProjectorResult, solve_projector
from cellctl.calib.views import RobotView, View, ordered
from cellctl.geometry import Array, Transform


@dataclass(frozen=True, eq=False)
class CellData:
    """What a run has collected of a cell with a fixed camera: views of the checkerboard, views of
    the marker board with robot poses (parent: world), pictures {id: camera px} of the projected
    markers with their projector px `centres`; and what was known before: the maker's camera, the
    table in the world frame, and the projector's lens from its data sheet."""

    intrinsic: Sequence[View]
    hand_eye: Sequence[RobotView]
    pictures: Sequence[Mapping[int, Array]]
    centres: Mapping[int, Array]
    factory: CameraModel
    table: Plane
    lens: LensPrior


@dataclass(frozen=True)
class Row:
    """A row of the table: which camera, whether the homography works on raw pixels, which
    hand-eye, and whether the projector's lens is modelled."""

    name: str
    camera: Literal["no distortion", "factory", "calibrated"]
    raw_pixels: bool = False
    reprojection: bool = False
    lens: bool = False


ROWS = (
    Row("no distortion model", "no distortion"),
    Row("factory K, D; homography on raw pixels", "factory", raw_pixels=True),
    Row("calibrated K, D; homography on raw pixels", "calibrated", raw_pixels=True),
    Row("undistorted before the homography, closed-form hand-eye (Park)", "calibrated"),
    Row("hand-eye by reprojection", "calibrated", reprojection=True),
    Row("projector radial distortion", "calibrated", reprojection=True, lens=True),
)


@dataclass(frozen=True, eq=False)
class Stage:
    """One row, solved: the errors are those of its projector map, in projector pixels."""

    name: str
    calibration: Calibration
    training_px: float
    held_out_px: float


def solve_stages(
    data: CellData,
    *,
    intrinsic: IntrinsicResult | None = None,
    hand_eye: HandEyeResult | None = None,
) -> list[Stage]:
    """All rows of the table. Results that are known already need not be solved again; views that
    they rejected are left out everywhere. SolveError as the solvers raise it."""
    size = data.factory.image_size
    intrinsic = intrinsic or solve_intrinsic(data.intrinsic, size)
    hand_eye = hand_eye or solve_hand_eye(data.hand_eye, "eye-to-hand", camera=intrinsic.camera)
    used = [view for view in data.intrinsic if view.id in intrinsic.used]
    cameras = {
        "no distortion": solve_intrinsic(used, size, distortion=False, warp=False).camera,
        "factory": data.factory,
        "calibrated": intrinsic.camera,
    }
    return [_solve(row, data, cameras[row.camera], hand_eye) for row in ROWS]


def _solve(row: Row, data: CellData, camera: CameraModel, hand_eye: HandEyeResult) -> Stage:
    projector = _projector(row, data, camera)
    calibration = Calibration(
        camera=camera,
        T_world_camera=hand_eye.camera_pose if row.reprojection else _park(data, camera, hand_eye),
        table=data.table,
        projector=projector.map,
        boards={hand_eye.board_pose.child: hand_eye.board_pose},
        raw_pixels=row.raw_pixels,
    )
    return Stage(row.name, calibration, projector.rms_px, projector.held_out_px)


def _projector(row: Row, data: CellData, camera: CameraModel) -> ProjectorResult:
    """On raw pixels: as if the camera had no distortion."""
    seen_by = CameraModel(camera.K, np.zeros(5), camera.image_size) if row.raw_pixels else camera
    return solve_projector(
        data.pictures, data.centres, seen_by, lens=data.lens if row.lens else None
    )


def _park(data: CellData, camera: CameraModel, hand_eye: HandEyeResult) -> Transform:
    """The camera's pose in closed form, from the views that the solution rests on."""
    names = {view.id for view in hand_eye.views}
    views = [view for view in ordered(data.hand_eye) if view.id in names]
    A = np.stack([view.T_base_flange.matrix for view in views])
    C = np.stack([board_pose(view, camera).matrix for view in views])
    X, _ = closed_form("park", A, C)
    return Transform(hand_eye.camera_pose.parent, hand_eye.camera_pose.child, X)
