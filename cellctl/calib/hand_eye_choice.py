"""Held-out comparison of the ways to solve hand-eye, and the choice between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import ChainState
from cellctl.calib.hand_eye_fit import Job, Option, RobotData, fit
from cellctl.calib.pose import board_poses
from cellctl.calib.views import RobotView, excess, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, invert, rotation_angle


@dataclass(frozen=True, eq=False)
class Fold:
    """One view, `left_out`, and the job that is left: views `kept`."""

    left_out: RobotData
    kept: Array
    job: Job


@dataclass(frozen=True, eq=False)
class Candidate:
    """How one option does: `state` is its solution from all used views; `held_out` the errors
    (k, 2) in px of each view, predicted through the robot without having been seen."""

    option: Option
    state: ChainState
    rms_px: float
    held_out: tuple[Array, ...]

    @property
    def held_out_px(self) -> float:
        return rms(np.concatenate(self.held_out))


def leave_one_out(job: Job) -> list[Fold]:
    """A fold for each view. A camera that came from the views is fitted again without it."""
    return [_fold(job, view) for view in range(len(job.data.views))]


def _fold(job: Job, view: int) -> Fold:
    kept = np.flatnonzero(np.arange(len(job.data.views)) != view)
    rest = job.keep(kept)
    if rest.camera_fit is not None:
        camera = rest.start.camera
        boards = [
            _nearest(one, camera, before)
            for one, before in zip(rest.data.views, rest.boards, strict=True)
        ]
        rest = replace(rest, boards=np.stack(boards))
    return Fold(job.data.subset([view]), kept, rest)


def _nearest(view: RobotView, camera: CameraModel, before: Array) -> Array:
    """Of the two poses that a picture allows, the one that was chosen before; which stays if the
    camera of this fold allows none."""
    try:
        poses = board_poses(view, camera)
    except SolveError:
        return before
    return min((pose.matrix for pose in poses), key=lambda m: rotation_angle(invert(before) @ m))


def evaluate(option: Option, job: Job, folds: Sequence[Fold]) -> Candidate | None:
    """Solve by an option, with every view left out once; None when it cannot be solved."""
    try:
        state = fit(option, job)
        held_out = tuple(_held_out(option, state, fold) for fold in folds)
    except SolveError:
        return None
    errors = job.data.through_robot(state)[job.data.batch.seen]
    if not np.isfinite(np.concatenate([errors, *held_out])).all():
        return None
    return Candidate(option, state, rms(errors), held_out)


def _held_out(option: Option, state: ChainState, fold: Fold) -> Array:
    """Errors (k, 2) of the left-out view: everything is fitted again without it, from `state`."""
    start = replace(state, corrections=state.corrections[fold.kept])
    if not option.camera:
        start = replace(start, camera=fold.job.start.camera)
    if not option.warp:
        start = replace(start, warp=fold.job.start.warp)
    rest = fit(option, replace(fold.job, start=start), tolerance=1e-6)
    return fold.left_out.through_robot(rest)[0]


def choose(candidates: Sequence[Candidate]) -> tuple[Candidate, str]:
    """The candidate to trust and why. `candidates` come in order of preference; the first that
    the data cannot tell from the best one wins, see `views.excess`."""
    best = min(candidates, key=lambda candidate: candidate.held_out_px)
    chosen = next(c for c in candidates if excess(c.held_out, best.held_out) <= 0.0)
    if chosen is best:
        return best, f"lowest held-out error, {best.held_out_px:.3f} px"
    return chosen, (
        f"held-out error {chosen.held_out_px:.3f} px; {best.option.name} reaches "
        f"{best.held_out_px:.3f} px, which is less than one standard error better"
    )
