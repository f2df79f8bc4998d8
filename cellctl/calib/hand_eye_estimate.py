"""Hand-eye while it is still being found out: from one view on, with what a tape measure says.

The search for the board and the planning of views ask after every picture; `solve_hand_eye` has
the last word.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import ChainState, PosePrior
from cellctl.calib.closed_form import consistent_options, robust_start
from cellctl.calib.hand_eye_fit import (
    ROBOT_SIGMA,
    Job,
    Mount,
    Noise,
    Option,
    PosePriors,
    Possible,
    RobotData,
    adjust,
    possible_poses,
)
from cellctl.calib.pose import BoardPose
from cellctl.calib.schur import Solution
from cellctl.calib.views import RobotView, ordered, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Transform, invert, rotation_angle

NOISE_PX = 0.3
"""Of a corner's coordinate: small against what the tape measure leaves open, and generous."""


@dataclass(frozen=True, eq=False)
class HandEyeEstimate:
    """`camera_pose` and `board_pose` as in HandEyeResult. `covariance` (12, 12) of small turns
    (rad) and shifts (m) of the camera, then of the board, each in its own child frame."""

    camera_pose: Transform
    board_pose: Transform
    covariance: Array
    rms_px: float

    @property
    def sigma(self) -> Array:
        """(4,): radians and metres of the camera, radians and metres of the board; lengths of
        the standard deviations over three axes."""
        return np.linalg.norm(np.sqrt(self.covariance.diagonal()).reshape(4, 3), axis=1)


TAPE = (0.1, float(np.radians(10.0)))
"""One standard deviation per axis of a tape-measured pose: metres and radians."""


def prior(pose: Transform, sigma: tuple[float, float]) -> PosePrior:
    """A pose known beforehand, with one standard deviation per axis in metres and in radians."""
    metres, radians = sigma
    return PosePrior(pose.matrix, np.repeat([radians, metres], 3))


def estimate(
    views: Iterable[RobotView],
    camera: CameraModel,
    camera_pose: Transform,
    board_pose: Transform,
    *,
    mount: Mount = "eye-to-hand",
    camera_sigma: tuple[float, float] = TAPE,
    board_sigma: tuple[float, float] = TAPE,
) -> HandEyeEstimate:
    """The poses of camera and board that views and earlier knowledge make most likely.

    Each pose comes with one standard deviation per axis, metres and radians. Works from one view
    on. SolveError when no view shows a pose of the board.
    """
    priors = PosePriors(prior(camera_pose, camera_sigma), prior(board_pose, board_sigma))
    found, lost = possible_poses(ordered(views), camera)
    if not found:
        raise SolveError("; ".join(r.reason for r in lost) or "no view of the board to start from")
    possible = list(found.values())
    starts = _starts(possible, mount, camera_pose.matrix, board_pose.matrix)
    tried = [_adjusted(possible, mount, camera, start, priors) for start in starts]
    solutions = [pair for pair in tried if pair is not None]
    if not solutions:
        raise SolveError("the views contradict the tape-measured poses: check those first")
    data, best = min(solutions, key=lambda pair: pair[1].cost)
    errors = data.through_robot(best.state)[data.batch.seen]
    return HandEyeEstimate(
        camera_pose=Transform(camera_pose.parent, camera_pose.child, best.state.camera_pose),
        board_pose=Transform(board_pose.parent, board_pose.child, best.state.board_pose),
        covariance=best.globals_covariance,
        rms_px=rms(errors),
    )


def _starts(
    possible: Sequence[Possible], mount: Mount, camera: Array, board: Array
) -> list[tuple[Array, Array]]:
    """Poses X, Y to start from: one measured, the other such that a possible pose of the first
    view's board is met; and the closed form where there are views enough."""
    A = RobotData.of([options[0][0] for options in possible], mount).reported
    starts = [(camera, board)]
    for _, pose in possible[0]:
        starts.append((camera, invert(A[0]) @ camera @ pose.matrix))
        starts.append((A[0] @ board @ invert(pose.matrix), board))
    if len(possible) >= 3:
        poses = [np.stack([pose.matrix for _, pose in options]) for options in possible]
        chosen = consistent_options(A, poses)
        try:
            boards = np.stack([p[i] for p, i in zip(poses, chosen, strict=True)])
            starts.append(robust_start(A, boards))
        except SolveError:
            return starts
    return starts


def _adjusted(
    possible: Sequence[Possible],
    mount: Mount,
    camera: CameraModel,
    start: tuple[Array, Array],
    priors: PosePriors,
) -> tuple[RobotData, Solution[ChainState]] | None:
    """The adjustment from one start; None when that start explains nothing."""
    X, Y = start
    A = RobotData.of([options[0][0] for options in possible], mount).reported
    chain = invert(X) @ A @ Y
    chosen = [_closest(*pair) for pair in zip(possible, chain, strict=True)]
    data = RobotData.of([view for view, _ in chosen], mount)
    boards = np.stack([pose.matrix for _, pose in chosen])
    state = ChainState(camera, X, Y, data.no_corrections)
    job = Job(data, boards, state, Noise(NOISE_PX, ROBOT_SIGMA), priors)
    try:
        solution = adjust(Option(""), job)
    except SolveError:
        return None
    return data, solution


def _closest(possible: Possible, expected: Array) -> tuple[RobotView, BoardPose]:
    """The possibility nearest to an expected pose of the board, a radian counting half a metre."""

    def off(pair: tuple[RobotView, BoardPose]) -> float:
        difference = invert(expected) @ pair[1].matrix
        return float(np.linalg.norm(difference[:3, 3]) + 0.5 * rotation_angle(difference))

    return min(possible, key=off)
