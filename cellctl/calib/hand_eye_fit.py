"""Fits of the hand-eye chain to some of the views: what the candidates are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.camera_fit import HUBER, CameraFit
from cellctl.calib.chain import FULL, Chain, ChainState, Free, PosePrior, Sheet
from cellctl.calib.closed_form import METHODS, closed_form
from cellctl.calib.pose import BoardPose, board_poses, pose_vectors
from cellctl.calib.schur import Solution, minimise
from cellctl.calib.views import Batch, Rejection, RobotView, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, invert, transform_points

Mount = Literal["eye-to-hand", "eye-in-hand"]
ROBOT_SIGMA = np.repeat([np.radians(0.05), 0.5e-3], 3)
"""How far a flange is from where its robot reports it, (6,) radians and metres, before the data
have been asked; industrial arms: 0.2-0.6 mm, 0.03-0.04 degrees."""
AMBIGUOUS = 3.0
"""The second pose that a picture of a plane allows counts up to that many times the error."""
PSEUDO_VIEWS = 2.0
"""ROBOT_SIGMA counts like what so many views would say."""


@dataclass(frozen=True)
class PosePriors:
    """Tape-measured poses of the camera on its anchor and of the board on its mount."""

    camera: PosePrior | None = None
    board: PosePrior | None = None


@dataclass(frozen=True, eq=False)
class RobotData:
    """Views with robot poses as arrays over n views; `sheet` is the printed area."""

    views: tuple[RobotView, ...]
    mount: Mount
    sheet: Sheet

    @classmethod
    def of(cls, views: Sequence[RobotView], mount: Mount) -> RobotData:
        return cls(tuple(views), mount, Sheet.of(np.concatenate([v.points for v in views])))

    @cached_property
    def batch(self) -> Batch:
        return Batch.of(self.views)

    @cached_property
    def reported(self) -> Array:
        """A (n, 4, 4) of A Y = X C, see `closed_form`."""
        flange = np.stack([view.T_base_flange.matrix for view in self.views])
        return flange if self.mount == "eye-to-hand" else invert(flange)

    @cached_property
    def no_corrections(self) -> Array:
        return np.broadcast_to(np.eye(4), self.reported.shape)

    def subset(self, index: Sequence[int] | Array) -> RobotData:
        return RobotData(tuple(self.views[i] for i in index), self.mount, self.sheet)

    def chain(self, free: Free, sigma_px: float = 1.0, sigma_robot: Array | None = None) -> Chain:
        ones = self.no_corrections
        to_hand = self.mount == "eye-to-hand"
        return Chain(
            batch=self.batch,
            before=self.reported if to_hand else ones,
            after=ones if to_hand else self.reported,
            sheet=self.sheet,
            free=free,
            sigma_px=sigma_px,
            sigma_robot=sigma_robot,
        )

    def through_robot(self, state: ChainState) -> Array:
        """Errors (n, k, 2) in px when the robot is believed; see `Chain.errors`."""
        return self.chain(Free()).errors(replace(state, corrections=self.no_corrections))


def predicted(view: RobotView, state: ChainState, mount: Mount, sheet: Sheet) -> Array:
    """Errors (k, 2) px of a view that a fit does not rest on, seen through the robot, with its
    board turned as fits best. What would lie behind the camera counts as a picture's diagonal."""
    diagonal = float(np.linalg.norm(state.camera.image_size))
    found = []
    for turn in view.symmetries:
        turned = replace(view, points=transform_points(turn, view.points))
        one = RobotData((turned,), mount, sheet)
        unturned = replace(state, corrections=one.no_corrections)
        found.append(np.nan_to_num(one.through_robot(unturned)[0], nan=diagonal))
    return min(found, key=rms)


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations: of a corner's coordinate in px, and (6,) of a reported flange pose."""

    px: float
    robot: Array


@dataclass(frozen=True, eq=False)
class Job:
    """What there is to solve: views, the poses `boards` T_camera_board (n, 4, 4) that each alone
    shows under start.camera, a start for all adjustments, noise and priors. `camera_fit` is the
    fit of the camera if it was calibrated from the same views."""

    data: RobotData
    boards: Array
    start: ChainState
    noise: Noise
    priors: PosePriors
    camera_fit: CameraFit | None = None

    def keep(self, index: Sequence[int] | Array) -> Job:
        """The same over some of the views; a camera that came from them is fitted again."""
        fit, start = self.camera_fit, self.start
        start = replace(start, corrections=start.corrections[index])
        if fit is not None:
            fit = fit.over(np.isin(np.arange(len(self.data.views)), index))
            start = replace(start, camera=fit.camera, warp=fit.state.warp)
        return replace(
            self,
            data=self.data.subset(index),
            boards=self.boards[index],
            start=start,
            camera_fit=fit,
        )

    def without(self, views: Sequence[int]) -> Job:
        return self.keep([i for i in range(len(self.data.views)) if i not in views])


Possible = list[tuple[RobotView, BoardPose]]
"""All that one picture allows: the view with its board turned, and where the board then is."""


def possible_poses(
    views: Sequence[RobotView], camera: CameraModel
) -> tuple[dict[str, Possible], list[Rejection]]:
    """By id: symmetries of the print times the two poses of a plane; and views without any."""
    found: dict[str, Possible] = {}
    lost = []
    for view in views:
        try:
            found[view.id] = [
                pair for turn in view.symmetries for pair in _poses(view, turn, camera)
            ]
        except SolveError as error:
            lost.append(Rejection(view.id, error.message))
    return found, lost


def _poses(view: RobotView, turn: Array, camera: CameraModel) -> Possible:
    turned = replace(view, points=transform_points(turn, view.points))
    poses = board_poses(turned, camera)
    return [(turned, pose) for pose in poses if pose.rms_px <= AMBIGUOUS * poses[0].rms_px]


@dataclass(frozen=True)
class Option:
    """One way to solve: a closed form by `method`, or the adjustment with these unknowns.

    `correlated` errors of a view's corners, as lens and board leave them, count like one corner;
    independent ones, as noise makes them, each for itself.
    """

    name: str
    method: str = ""
    camera: bool = False
    scale: bool = False
    warp: bool = False
    exact_robot: bool = False
    correlated: bool = False

    @property
    def free(self) -> Free:
        return Free(
            FULL if self.camera else (),
            poses=True,
            scale=self.scale,
            warp=self.warp,
            corrections=not self.exact_robot,
        )


def options(*, free_camera: bool) -> list[Option]:
    """All candidates; the ones to prefer when the data cannot tell come first."""
    cameras = (False, True) if free_camera else (False,)
    boards = ((False, False), (True, False), (True, True))
    adjustments = [
        _adjustment(camera=camera, scale=scale, warp=warp, exact=exact)
        for exact in (False, True)
        for scale, warp in boards
        for camera in cameras
    ]
    return adjustments + [Option(f"closed form, {name}", name) for name in METHODS]


def _adjustment(*, camera: bool, scale: bool, warp: bool, exact: bool) -> Option:
    free = [word for word, on in (("camera", camera), ("scale", scale), ("warp", warp)) if on]
    robot = "exact robot" if exact else "noisy robot"
    name = f"adjustment, {robot}" + (f", free {', '.join(free)}" if free else "")
    return Option(name, "", camera, scale, warp, exact, correlated=True)


def fit(option: Option, job: Job, tolerance: float = 1e-10) -> ChainState:
    """Solve by one option."""
    if option.method:
        X, Y = closed_form(option.method, job.data.reported, job.boards)
        return ChainState(job.start.camera, X, Y, job.data.no_corrections)
    return adjust(option, job, tolerance).state


def adjust(option: Option, job: Job, tolerance: float = 1e-10) -> Solution[ChainState]:
    """The adjustment of an option, from the job's start."""
    inflation = np.sqrt(job.data.batch.seen.sum(axis=1).mean()) if option.correlated else 1.0
    chain = replace(
        job.data.chain(option.free, job.noise.px * inflation, job.noise.robot),
        camera_prior=job.priors.camera,
        board_prior=job.priors.board,
    )
    start = job.start
    if option.exact_robot:
        start = replace(start, corrections=job.data.no_corrections)
    return minimise(chain, start, huber=HUBER / inflation, tolerance=tolerance)


def estimate_noise(job: Job) -> Job:
    """With the robot's noise as the data ask for it, started from the fit that this took.

    Variance components after W. Foerstner, 1979: the sum of squares of a group of corrections
    over its redundancy, repeated until it settles.
    """
    option, state = Option("", scale=True, warp=True), job.start
    noise = Noise(job.noise.px, ROBOT_SIGMA)
    for _ in range(4):
        solution = adjust(option, replace(job, start=state, noise=noise), 1e-6)
        state = solution.state
        noise = Noise(noise.px, _robot_sigma(solution, noise.robot))
    state = replace(state, log_scale=job.start.log_scale, warp=job.start.warp)
    return replace(job, start=state, noise=noise)


def _robot_sigma(solution: Solution[ChainState], sigma: Array) -> Array:
    """(6,) from the corrections of a fit that assumed `sigma`: turns alike, shifts alike."""
    squares = np.square(pose_vectors(solution.state.corrections)).reshape(-1, 2, 3)
    variances = np.diagonal(solution.locals_covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    unexplained = variances.sum(axis=(0, 2)) / sigma[::3] ** 2
    redundancy = np.maximum(3.0 * len(squares) - unexplained, 0.0)
    pseudo = 3.0 * PSEUDO_VIEWS
    total = squares.sum(axis=(0, 2)) + pseudo * ROBOT_SIGMA[::3] ** 2
    return np.repeat(np.sqrt(total / (redundancy + pseudo)), 3)
