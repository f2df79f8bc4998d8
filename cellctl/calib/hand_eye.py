"""Hand-eye: where the camera stands, and where the board sits, from pictures and robot poses.

Eye-to-hand (camera fixed, board on the flange) yields T_base_camera and T_flange_board;
eye-in-hand yields T_flange_camera and T_base_board. Closed forms start an adjustment of the
reprojection errors; the error on views that a solution has not seen decides between them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.camera_fit import (
    MINIMUM_POINTS,
    MINIMUM_VIEWS,
    require_views,
    usable_views,
)
from cellctl.calib.chain import ChainState, Free, Sheet
from cellctl.calib.closed_form import (
    axis_scatter_deg,
    discrepancies,
    robust_start,
    scaled,
    scaled_start,
)
from cellctl.calib.drift import Drift, find_drift
from cellctl.calib.hand_eye_choice import Candidate, choose, evaluate, leave_one_out
from cellctl.calib.hand_eye_faults import (
    Evidence,
    SolvedChain,
    board_factor,
    explained,
    require_sense,
)
from cellctl.calib.hand_eye_fit import (
    ROBOT_SIGMA,
    Job,
    Mount,
    Noise,
    Option,
    PosePriors,
    RobotData,
    adjust,
    estimate_noise,
    options,
    predicted,
)
from cellctl.calib.hand_eye_result import HandEyeLimits, HandEyeResult, HandEyeView, judge
from cellctl.calib.hand_eye_sight import Sight, look, oriented
from cellctl.calib.pose import pose_vectors
from cellctl.calib.schur import minimise
from cellctl.calib.views import Rejection, RobotView, ordered, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Transform, invert, rotation_angle, transform_points

__all__ = ["HandEyeLimits", "HandEyeResult", "HandEyeView", "PosePriors", "judge", "solve_hand_eye"]

NEED = (
    f"views with robot poses; hand-eye needs at least {MINIMUM_VIEWS}, turned about at least two "
    "axes"
)
GROSS_M, GROSS_RAD, GROSS_MEDIANS = 0.02, np.radians(2.0), 5.0
"""Before any fit is believed a view may be off by that much, and that many times the median."""
STRAIN_SIGMAS, STRAIN_FACTOR = 4.0, 3.0
"""A left-out view is bad when its robot pose has to be bent that many robust standard deviations
more than the median view's, and that many times as far."""
NO_PRIORS = PosePriors()


def solve_hand_eye(
    views: Iterable[RobotView],
    mount: Mount,
    *,
    camera: CameraModel | None = None,
    image_size: tuple[int, int] | None = None,
    priors: PosePriors = NO_PRIORS,
    minimum_points: int = MINIMUM_POINTS,
    board: str = "board",
) -> HandEyeResult:
    """Solve from views with robot poses.

    Without `camera` it is calibrated from the same views, whose pictures are of `image_size`.
    `board` names the board's frame in the result. SolveError says what is missing when the
    views do not determine an answer.
    """
    every = ordered(views)
    usable, rejected = usable_views(every, minimum_points)
    require_views(usable, rejected, NEED)
    sight = look(usable, camera, image_size, minimum_points)
    rejected = [*rejected, *sight.lost]
    require_views(sight.views, rejected, NEED)
    job, gross, factor = _job(sight, mount, priors)
    job, strained = _without_strained(job)
    require_views(job.data.views, [*rejected, *gross, *strained], NEED)
    wrong = _explained(job, sight, [*gross, *strained], factor)
    rejected = sorted([*rejected, *wrong], key=lambda r: r.id)
    result = _result(job, every, _candidates(job), board, factor)
    return replace(result, rejected=tuple(rejected))


def _job(sight: Sight, mount: Mount, priors: PosePriors) -> tuple[Job, list[Rejection], float]:
    """Orientation of the board, start; gross errors out; and the factor by which the board was
    enlarged because it is another one than stated."""
    views, boards, noise = oriented(list(sight.found.values()), mount, sight.camera)
    data = RobotData.of(views, mount)
    start = scaled_start(data.reported, boards)
    require_sense(Evidence.of(list(sight.found.values()), mount), start)
    factor = board_factor(start)
    fit, boards, warp = sight.fit, scaled(boards, factor), factor * sight.warp
    if factor != 1.0:
        views = [replace(view, points=factor * view.points) for view in views]
        data = RobotData.of(views, mount)
        fit = fit and fit.rescaled(factor)
    X, Y = robust_start(data.reported, boards)
    state = ChainState(sight.camera, X, Y, data.no_corrections, warp=warp)
    noise = fit.sigma_px if fit else noise
    job, gross = _without_gross(Job(data, boards, state, Noise(noise, ROBOT_SIGMA), priors, fit))
    return estimate_noise(job), gross, factor


def _explained(job: Job, sight: Sight, rejected: list[Rejection], factor: float) -> list[Rejection]:
    """With what has happened to views whose robot pose does not fit."""
    if not rejected:
        return []
    state, data = job.start, job.data
    shifts, angles = discrepancies(state.camera_pose, state.board_pose, data.reported, job.boards)
    chain = SolvedChain(
        state.camera_pose,
        state.board_pose,
        data.mount,
        float(np.median(shifts)),
        float(np.median(angles)),
    )
    possible = {
        name: scaled(np.stack([pose.matrix for _, pose in options]), factor)
        for name, options in sight.found.items()
    }
    points = factor * np.concatenate([view.points for view in sight.views])
    return explained(chain, rejected, sight.views, possible, np.unique(points, axis=0))


def _without_gross(job: Job) -> tuple[Job, list[Rejection]]:
    """Take out views that the robust start does not explain, even roughly."""
    state = job.start
    shifts, angles = discrepancies(
        state.camera_pose, state.board_pose, job.data.reported, job.boards
    )
    bad = (shifts > GROSS_M + GROSS_MEDIANS * np.median(shifts)) | (
        angles > GROSS_RAD + GROSS_MEDIANS * np.median(angles)
    )
    if not bad.any():
        return job, []
    found = np.flatnonzero(bad).tolist()
    return job.without(found), [_disagrees(job, i, shifts, angles) for i in found]


def _disagrees(job: Job, view: int, shifts: Array, angles: Array) -> Rejection:
    return Rejection(
        job.data.views[view].id,
        f"robot pose and picture disagree by {1e3 * shifts[view]:.1f} mm and "
        f"{np.degrees(angles[view]):.2f} deg (the median view by {1e3 * np.median(shifts):.1f} mm "
        f"and {np.degrees(np.median(angles)):.2f} deg): was the picture taken at another pose?",
    )


def _without_strained(job: Job) -> tuple[Job, list[Rejection]]:
    """Take out, one by one, views whose robot pose does not fit what all others say."""
    rejected: list[Rejection] = []
    while len(job.data.views) > MINIMUM_VIEWS + 1:
        strains, shifts, angles = _strains(job)
        median = float(np.median(strains))
        spread = 1.4826 * float(np.median(np.abs(strains - median)))
        worst = int(np.argmax(strains))
        if strains[worst] <= max(median + STRAIN_SIGMAS * spread, STRAIN_FACTOR * median):
            break
        rejected.append(_disagrees(job, worst, shifts, angles))
        job = estimate_noise(job.without([worst]))
    return job, rejected


def _strains(job: Job) -> tuple[Array, Array, Array]:
    """For each view, left out of the fit: how far its robot pose has to be bent to meet its
    picture, in standard deviations, in metres and in radians, (n,) each."""
    option, camera_given = Option("", scale=True, warp=True), replace(job, camera_fit=None)
    bent = []
    for i in range(len(job.data.views)):
        rest = adjust(option, camera_given.without([i]), tolerance=1e-6).state
        chain = job.data.subset([i]).chain(Free(), job.noise.px, job.noise.robot)
        alone = minimise(chain, replace(rest, corrections=np.eye(4)[None])).state
        bent.append(alone.corrections[0])
    vectors = pose_vectors(np.stack(bent))
    return (
        np.linalg.norm(vectors / job.noise.robot, axis=1),
        np.linalg.norm(vectors[:, 3:], axis=1),
        np.linalg.norm(vectors[:, :3], axis=1),
    )


def _candidates(job: Job) -> list[Candidate]:
    folds = leave_one_out(job)
    tried = options(free_camera=job.camera_fit is not None)
    found = [evaluate(option, job, folds) for option in tried]
    solved = [candidate for candidate in found if candidate is not None]
    if not solved:
        raise SolveError(
            "no method solves hand-eye with every view left out once: add views that turn the "
            "flange about at least two axes"
        )
    return solved


def _result(
    job: Job,
    every: Sequence[RobotView],
    candidates: Sequence[Candidate],
    board: str,
    factor: float,
) -> HandEyeResult:
    """All that can be said about the chosen candidate; rejections are added by the caller."""
    chosen, why = choose(candidates)
    data, state = job.data, chosen.state
    names = {view.id for view in data.views}
    sheet = Sheet(data.sheet.centre / factor, data.sheet.half / factor)
    whole = replace(state, log_scale=state.log_scale + float(np.log(factor)))
    others = [predicted(view, whole, data.mount, sheet) for view in every if view.id not in names]
    anchor, mount = _frames(data)
    return HandEyeResult(
        mount=data.mount,
        camera=state.camera,
        camera_pose=Transform(anchor, "camera", state.camera_pose),
        board_pose=Transform(mount, board, state.board_pose),
        covariance=_covariance(job, chosen),
        chosen=chosen.option.name,
        why=why,
        candidates=tuple(candidates),
        scale=float(np.exp(whole.log_scale)),
        warp=state.warp,
        sheet=sheet,
        pitch_m=_pitch(every),
        robot_sigma=job.noise.robot,
        axis_scatter_deg=axis_scatter_deg(data.reported),
        rms_px=chosen.rms_px,
        held_out_px=rms(np.concatenate([*chosen.held_out, *others])),
        held_out_used_px=chosen.held_out_px,
        views=_views(data, chosen),
        rejected=(),
        drift=_drift(job),
        turned=_turned(data.views, every, factor),
    )


def _turned(
    used: Sequence[RobotView], every: Sequence[RobotView], factor: float
) -> tuple[str, ...]:
    """Views whose board had to be turned against the others'."""
    given = {view.id: factor * view.points for view in every}
    turned = {view.id for view in used if not np.allclose(view.points, given[view.id])}
    if 2 * len(turned) > len(used):
        turned = {view.id for view in used} - turned
    return tuple(sorted(turned))


def _drift(job: Job) -> Drift | None:
    """What pictures and robot disagree about, at the middle of the board, view by view."""
    state, data = job.start, job.data
    chain = data.chain(Free())
    D = state.corrections
    middle = transform_points(state.board_pose, np.append(data.sheet.centre, 0.0))
    at = chain.after @ np.append(middle, 1.0)
    shifts = ((D - np.eye(4)) @ at[..., None])[:, :3, 0]
    frames = chain.before if data.mount == "eye-to-hand" else invert(chain.after)
    names = [view.id for view in data.views]
    return find_drift(names, pose_vectors(D)[:, :3], shifts, frames[:, :3, :3])


def _pitch(views: Sequence[RobotView]) -> float:
    """The side of a square or marker, or the spacing of dots, as stated: the smallest distance
    between points that follow each other, metres."""
    steps = [np.linalg.norm(np.diff(view.points, axis=0), axis=1) for view in views]
    return float(np.concatenate(steps).min())


def _frames(data: RobotData) -> tuple[str, str]:
    """Names of the frames that carry the camera and the board."""
    reported = data.views[0].T_base_flange
    if data.mount == "eye-to-hand":
        return reported.parent, reported.child
    return reported.child, reported.parent


def _views(data: RobotData, chosen: Candidate) -> tuple[HandEyeView, ...]:
    errors, seen = data.through_robot(chosen.state), data.batch.seen
    off_m, off_rad = _spread(data, chosen.state)
    return tuple(
        HandEyeView(
            id=view.id,
            rms_px=rms(errors[i][seen[i]]),
            held_out_px=rms(chosen.held_out[i]),
            off_mm=float(1e3 * off_m[i]),
            off_deg=float(np.degrees(off_rad[i])),
        )
        for i, view in enumerate(data.views)
    )


def _spread(data: RobotData, state: ChainState) -> tuple[Array, Array]:
    """Metres and radians (n,) between where each picture alone and where the chain has the
    board, at the middle of its print."""
    chain = data.chain(Free())
    state = replace(state, corrections=data.no_corrections)
    off = invert(chain.poses(state)) @ chain.poses(minimise(chain, state).state)
    middle = np.append(data.sheet.centre, 0.0)
    moved = np.array([transform_points(matrix, middle) for matrix in off]) - middle
    return np.linalg.norm(moved, axis=1), np.array([rotation_angle(matrix) for matrix in off])


def _covariance(job: Job, chosen: Candidate) -> Array:
    """(12, 12) of both poses with the robot's noise as estimated, whatever was chosen."""
    option = replace(chosen.option, method="", exact_robot=False, correlated=False)
    start = replace(chosen.state, corrections=job.data.no_corrections)
    first = len(option.free.intrinsics)
    covariance = adjust(option, replace(job, start=start)).globals_covariance
    return covariance[first : first + 12, first : first + 12]
