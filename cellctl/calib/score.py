"""A calibration scored on views that it never saw, of the same set-up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib import hand_eye_fit, intrinsic
from cellctl.calib.closed_form import discrepancies
from cellctl.calib.hand_eye_result import HandEyeResult
from cellctl.calib.intrinsic import IntrinsicResult
from cellctl.calib.views import RobotView, View, rms
from cellctl.errors import BadInput
from cellctl.geometry import Array, invert, rotation_angle, transform_points

MOVED_M, MOVED_RAD, MOVED_SCATTERS = 0.01, np.radians(2.0), 5.0
"""The board sits elsewhere when the median view has it that far from its place, and that many
times as far as the views' places for it are from each other."""


@dataclass(frozen=True, eq=False)
class Score:
    """Errors (k, 2) in px of each view, by its id."""

    errors: dict[str, Array]

    @property
    def px(self) -> float:
        """Over all points of all views: sqrt(mean(dx^2 + dy^2))."""
        return rms(np.concatenate(list(self.errors.values())))

    @property
    def per_view_px(self) -> dict[str, float]:
        return {name: rms(errors) for name, errors in self.errors.items()}


def score_camera(result: IntrinsicResult, views: Sequence[View], *, same_board: bool) -> Score:
    """Views under the camera, each with its own pose of the board and nothing else fitted.

    The bend that was found counts if it is the `same_board`.
    """
    warp = result.warp if same_board else np.zeros(3)
    return Score({v.id: intrinsic.predicted(v, result.camera, warp, result.sheet) for v in views})


def score_hand_eye(result: HandEyeResult, views: Sequence[RobotView]) -> Score:
    """Views predicted through the robot: camera, both poses and board as they were found.

    BadInput when the views agree with each other that the board sits elsewhere: that is another
    set-up, and its error would say nothing about the calibration.
    """
    _require_place(result, views)
    state, mount, sheet = result.state, result.mount, result.sheet
    return Score({v.id: hand_eye_fit.predicted(v, state, mount, sheet) for v in views})


def _require_place(result: HandEyeResult, views: Sequence[RobotView]) -> None:
    places = _board_places(result, views)
    if len(places) < 3:
        return
    middle = np.append(result.sheet.centre, 0.0)
    off = np.array([transform_points(place, middle) for place in places]) - middle
    shift = np.median(off, axis=0)
    apart = np.linalg.norm(off - shift, axis=1)
    central = places[int(np.argmin(apart))]
    turn = rotation_angle(central)
    turn_scatter = float(np.median([rotation_angle(invert(central) @ place) for place in places]))
    length, shift_scatter = float(np.linalg.norm(shift)), float(np.median(apart))
    moved = length > max(MOVED_M, MOVED_SCATTERS * shift_scatter)
    turned = turn > max(MOVED_RAD, MOVED_SCATTERS * turn_scatter)
    if moved or turned:
        raise BadInput(
            f"the board sits elsewhere on its mount than in the calibration, by {1e3 * length:.0f} "
            f"mm and {np.degrees(turn):.1f} deg: a score needs views of the same set-up"
        )


def _board_places(result: HandEyeResult, views: Sequence[RobotView]) -> Array:
    """(n, 4, 4): where each picture alone and the robot have the board, relative to where the
    calibration has it; of what a picture allows the nearest."""
    found, _ = hand_eye_fit.possible_poses(views, result.camera)
    X, Y = result.camera_pose.matrix, result.board_pose.matrix
    places = []
    for possible in found.values():
        A = hand_eye_fit.RobotData.of([possible[0][0]], result.mount).reported[0]
        poses = np.stack([pose.matrix for _, pose in possible])
        shifts, angles = discrepancies(X, Y, A[None], poses)
        best = int(np.argmin(shifts + 0.5 * angles))
        places.append(invert(A @ Y) @ X @ poses[best])
    return np.array(places).reshape(-1, 4, 4)
