"""What the boards and the projected markers tell, solved together: camera, its place, projector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict

from cellctl.calib import stages
from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.hand_eye import HandEyeResult
from cellctl.calib.intrinsic import IntrinsicResult
from cellctl.calib.projector import ProjectorResult
from cellctl.config import CellConfig
from cellctl.procedures import hand_eye, intrinsic, projector
from cellctl.procedures.hand_eye import HandEyeParams
from cellctl.procedures.intrinsic import IntrinsicParams
from cellctl.procedures.knowledge import factory_camera, lens_prior, table_plane
from cellctl.procedures.observations import Collected
from cellctl.procedures.projector import ProjectorParams, Shown
from cellctl.procedures.record import Record

INTRINSIC, HAND_EYE, PROJECTOR = "intrinsic", "hand-eye", "projector"


class OpticalParams(BaseModel):
    """The parameters of the parts."""

    model_config = ConfigDict(extra="forbid")

    intrinsic: IntrinsicParams = IntrinsicParams()
    hand_eye: HandEyeParams = HandEyeParams()
    projector: ProjectorParams = ProjectorParams()


@dataclass(frozen=True, eq=False)
class Optical:
    """What was seen in the three parts, and what was solved from it."""

    checker: Collected
    markers: Collected
    shown: Shown
    camera: IntrinsicResult
    pose: HandEyeResult
    light: ProjectorResult

    def calibration(self, table: Plane) -> Calibration:
        """Of the cell with that table."""
        return Calibration(
            camera=self.camera.camera,
            T_world_camera=self.pose.camera_pose,
            table=table,
            projector=self.light.map,
            boards={hand_eye.BOARD: self.pose.board_pose},
            quality={
                "camera_held_out_px": self.camera.held_out_px,
                "camera_sigma": self.camera.sigma.tolist(),
                "hand_eye_held_out_px": self.pose.held_out_px,
                "hand_eye_covariance": self.pose.covariance.tolist(),
                "projector_held_out_px": self.light.held_out_px,
            },
        )

    def stages(self, config: CellConfig) -> list[stages.Stage]:
        """The published pipeline, stage by stage, on the same data; the table as it was known
        before it was measured."""
        cell = stages.CellData(
            intrinsic=self.checker.views,
            hand_eye=self.markers.views,
            pictures=self.shown.pictures,
            centres=self.shown.centres,
            factory=factory_camera(config),
            table=table_plane(config),
            lens=lens_prior(config),
        )
        return stages.solve_stages(cell, intrinsic=self.camera, hand_eye=self.pose)

    def judged(self, params: OpticalParams, config: CellConfig) -> dict[str, tuple[str, ...]]:
        """Why each part fails, by its name."""
        return {
            INTRINSIC: intrinsic.judge(self.camera, params.intrinsic, config)[1],
            HAND_EYE: hand_eye.judge(self.pose, params.hand_eye)[1],
            PROJECTOR: projector.judge(self.light, self.shown, params.projector)[1],
        }

    def data(self) -> dict[str, dict[str, Any]]:
        """What is told of each part."""
        return {
            INTRINSIC: self.checker.merged(self.camera.to_dict()),
            HAND_EYE: self.markers.merged(self.pose.to_dict()),
            PROJECTOR: self.light.to_dict(),
        }


def solve(record: Record[Any], params: OpticalParams) -> Optical:
    """Pure: all three, one after the other, from what was recorded in the scopes of their names."""
    checker = intrinsic.seen(record.scoped(INTRINSIC, params.intrinsic))
    markers = hand_eye.seen(record.scoped(HAND_EYE, params.hand_eye))
    shown = projector.seen(record.scoped(PROJECTOR, params.projector))
    camera = intrinsic.solve(checker)
    return Optical(
        checker=checker,
        markers=markers,
        shown=shown,
        camera=camera,
        pose=hand_eye.solve(markers, camera.camera),
        light=projector.solve(shown, camera.camera, lens_prior(record.config)),
    )
