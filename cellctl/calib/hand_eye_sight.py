"""What the pictures of hand-eye views say, before the robot is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.camera_fit import MINIMUM_VIEWS, CameraFit
from cellctl.calib.closed_form import consistent_options
from cellctl.calib.hand_eye_fit import Mount, Possible, RobotData, possible_poses
from cellctl.calib.intrinsic import best_camera
from cellctl.calib.views import Rejection, RobotView, noise_px
from cellctl.errors import SolveError
from cellctl.geometry import Array, transform_points


@dataclass(frozen=True, eq=False)
class Sight:
    """What pictures alone say: the camera (and its fit, if it comes from them), what each allows
    by its id, the views without a pose, and the bend of the board."""

    camera: CameraModel
    fit: CameraFit | None
    found: dict[str, Possible]
    lost: list[Rejection]
    warp: Array

    @property
    def views(self) -> list[RobotView]:
        return [possible[0][0] for possible in self.found.values()]


def look(
    views: list[RobotView],
    camera: CameraModel | None,
    image_size: tuple[int, int] | None,
    minimum_points: int,
) -> Sight:
    """With a camera that is known, or with one from these pictures."""
    if camera is not None:
        return Sight(camera, None, *possible_poses(views, camera), np.zeros(3))
    fit, rejected = _camera_of(views, image_size, minimum_points)
    fit, found, lost = located(views, fit)
    return Sight(fit.camera, fit, found, [*rejected, *lost], fit.state.warp)


def _camera_of(
    views: list[RobotView], image_size: tuple[int, int] | None, minimum_points: int
) -> tuple[CameraFit, list[Rejection]]:
    """A camera from the hand-eye views themselves."""
    if image_size is None:
        raise SolveError("a camera or the size of the pictures is needed")
    best = best_camera(views, image_size, minimum_points=minimum_points)
    return best.fit, best.rejected


def located(
    views: list[RobotView], fit: CameraFit
) -> tuple[CameraFit, dict[str, Possible], list[Rejection]]:
    """What the pictures allow under a camera that came from them. A view that has no pose under
    it is lost to the camera too, which may cost another view its pose."""
    lost: list[Rejection] = []
    while True:
        used = [view for view in views if view.id in fit.names]
        found, more = possible_poses(used, fit.camera)
        lost += more
        if not more or len(found) < MINIMUM_VIEWS:
            return fit, found, lost
        fit = fit.over(np.isin(fit.names, list(found)))


def oriented(
    found: Sequence[Possible], mount: Mount, camera: CameraModel
) -> tuple[list[RobotView], Array, float]:
    """Views with the board turned the same way in all of them, the poses of the board, and the
    noise of a coordinate of a corner in px."""
    views = [possible[0][0] for possible in found]
    poses = [np.stack([pose.matrix for _, pose in possible]) for possible in found]
    places = consistent_options(RobotData.of(views, mount).reported, poses)
    chosen = [possible[i] for possible, i in zip(found, places, strict=True)]
    errors = [
        camera.project(transform_points(pose.matrix, view.points)) - view.pixels
        for view, pose in chosen
    ]
    boards = np.stack([pose.matrix for _, pose in chosen])
    return [view for view, _ in chosen], boards, noise_px(np.concatenate(errors))
