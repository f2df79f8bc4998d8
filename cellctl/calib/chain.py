"""The chain from a board to its picture, and its adjustment.

    p_camera = T_anchor_camera^-1  B_i  D_i  F_i  T_mount_board  q

Eye-to-hand: anchor = base, mount = flange, B_i = T_base_flange, F_i = 1. Eye-in-hand: anchor =
flange, mount = base, B_i = 1, F_i = T_base_flange^-1. D_i is small: how far the flange of view i
truly was from where the robot reported it, tied to zero by the robot's noise. With B = F = 1,
the anchor at the camera and D_i free, the same chain calibrates a camera alone.

q is the printed point where it truly is: scaled, because printers scale, and lifted by a
quadratic warp, because boards are not flat (0.3 mm of bend over a 0.3 m board biases a focal
length by 0.4 %). The warp is mrcal's `calobject_warp` with a mixed term.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.pose import (
    derivatives_by_pose,
    pose_matrices,
    pose_vector_derivatives,
    pose_vectors,
)
from cellctl.calib.schur import Linearised, Priors
from cellctl.calib.views import Batch
from cellctl.geometry import Array, Mask, invert

PINHOLE = (0, 1, 2, 3)
FULL = tuple(range(9))
"""Free intrinsic parameters: places in camera.INTRINSICS."""
SCALE_SIGMA, WARP_SIGMA = 0.1, 0.01
"""How far boards are off before the data have been asked: scale, and lift at the edge of the
board in half lengths. Printers scale by less than a percent; people mistake one board for
another, and a prior that did not allow for it would bend the camera instead."""


@dataclass(frozen=True, eq=False)
class ChainState:
    """Unknowns: the camera, its pose T_anchor_camera and the board's T_mount_board (4, 4), the
    logarithm of the board's scale, its warp (3,) in metres, and the corrections D (n, 4, 4)."""

    camera: CameraModel
    camera_pose: Array
    board_pose: Array
    corrections: Array
    log_scale: float = 0.0
    warp: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Free:
    """What an adjustment may change: globals, and the corrections of each view."""

    intrinsics: tuple[int, ...] = ()
    poses: bool = False
    scale: bool = False
    warp: bool = False
    corrections: bool = True

    @property
    def count(self) -> int:
        return len(self.intrinsics) + 12 * self.poses + self.scale + 3 * self.warp


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A pose known beforehand, (4, 4), with standard deviations (6,): three angles in radians,
    then three lengths in metres."""

    mean: Array
    sigma: Array

    def whitened(self, pose: Array) -> tuple[Array, Array]:
        """Residuals (6,) of a pose, and their derivatives (6, 6) by T @ pose(d)."""
        off = (invert(self.mean) @ pose)[None]
        slopes = pose_vector_derivatives(off)[0] / self.sigma[:, None]
        return pose_vectors(off)[0] / self.sigma, slopes


@dataclass(frozen=True, eq=False)
class Sheet:
    """The printed area: its centre (2,) and half its size (2,), metres."""

    centre: Array
    half: Array

    @classmethod
    def of(cls, points: Array) -> Sheet:
        """That spans board points (n, 3)."""
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        return cls((low + high) / 2, np.maximum((high - low) / 2, 1e-9))

    def lift(self, points: Array) -> Array:
        """(..., 3): 1 - u^2, 1 - v^2 and u v of points (..., 3), u and v from -1 to 1."""
        u, v = np.moveaxis((points[..., :2] - self.centre) / self.half, -1, 0)
        return np.stack([1.0 - u * u, 1.0 - v * v, u * v], axis=-1)


@dataclass(frozen=True, eq=False)
class Chain:
    """A least-squares problem (see schur.Problem) over `batch`.

    `before` B and `after` F are (n, 4, 4); `sheet` says what a warp is relative to; `sigma_px`
    is the noise of a coordinate of a corner, `sigma_robot` (6,) that of D in radians and metres
    (None: D is free).
    """

    batch: Batch
    before: Array
    after: Array
    sheet: Sheet
    free: Free
    sigma_px: float = 1.0
    sigma_robot: Array | None = None
    camera_prior: PosePrior | None = None
    board_prior: PosePrior | None = None

    @cached_property
    def lift(self) -> Array:
        """(n, k, 3): what each unit of warp lifts each point by, along the board's z."""
        return self.sheet.lift(self.batch.points)

    def board_points(self, state: ChainState) -> Array:
        """The printed points (n, k, 3) where they truly are on the board."""
        points = np.exp(state.log_scale) * self.batch.points
        if state.warp.any():
            points[..., 2] += self.lift @ state.warp
        return points

    def poses(self, state: ChainState) -> Array:
        """T_camera_board (n, 4, 4)."""
        inverse = invert(state.camera_pose)
        return inverse @ self.before @ state.corrections @ self.after @ state.board_pose

    def points(self, state: ChainState) -> Array:
        """Board points (n, k, 3) in the camera frame."""
        return _apply(self.poses(state), self.board_points(state))

    def errors(self, state: ChainState) -> Array:
        """Reprojection errors (n, k, 2) in pixels, zero where nothing was seen, not-a-number
        for what would lie behind the camera."""
        off = state.camera.project(self.points(state)) - self.batch.pixels
        return np.where(self.batch.seen[..., None], off, 0.0)

    def residuals(self, state: ChainState) -> Array:
        return self.errors(state) / self.sigma_px

    def linearise(self, state: ChainState) -> Linearised:
        on_board, poses = self.board_points(state), self.poses(state)
        in_camera = _apply(poses, on_board)
        pixels, by_point, by_intrinsics = state.camera.jacobians(
            in_camera, intrinsics=bool(self.free.intrinsics)
        )
        weights = (self.batch.seen / self.sigma_px)[..., None]
        by_point = by_point * weights[..., None]
        by_board_point = by_point @ poses[:, None, :3, :3]
        columns = [by_intrinsics[..., list(self.free.intrinsics)] * weights[..., None]]
        if self.free.poses:
            columns.append(-derivatives_by_pose(by_point, in_camera))
            columns.append(derivatives_by_pose(by_board_point, on_board))
        if self.free.scale:
            columns.append(
                by_board_point @ (np.exp(state.log_scale) * self.batch.points)[..., None]
            )
        if self.free.warp:
            columns.append(by_board_point[..., 2:] * self.lift[..., None, :])
        return Linearised(
            residuals=(pixels - self.batch.pixels) * weights,
            by_globals=np.concatenate(columns, axis=-1),
            by_locals=self._by_correction(state, on_board, by_point),
        )

    def _by_correction(self, state: ChainState, on_board: Array, by_point: Array) -> Array:
        if not self.free.corrections:
            return by_point[..., :0]
        moved = _apply(self.after @ state.board_pose, on_board)
        outer = (invert(state.camera_pose) @ self.before @ state.corrections)[:, None, :3, :3]
        return derivatives_by_pose(by_point @ outer, moved)

    def priors(self, state: ChainState) -> Priors:
        on_globals, globals_jacobian = self._priors_on_globals(state)
        n = len(state.corrections)
        if self.sigma_robot is None or not self.free.corrections:
            size = 6 * self.free.corrections
            return Priors(on_globals, globals_jacobian, np.zeros((n, 0)), np.zeros((n, 0, size)))
        return Priors(
            on_globals,
            globals_jacobian,
            pose_vectors(state.corrections) / self.sigma_robot,
            pose_vector_derivatives(state.corrections) / self.sigma_robot[:, None],
        )

    def _priors_on_globals(self, state: ChainState) -> tuple[Array, Array]:
        """What is known of poses (if told), and of what a printer does to a board (always)."""
        place, count = len(self.free.intrinsics), self.free.count
        residuals, jacobians = [np.zeros(0)], [np.zeros((0, count))]

        def add(residual: Array, jacobian: Array) -> None:
            block = np.zeros((len(residual), count))
            block[:, place : place + jacobian.shape[1]] = jacobian
            residuals.append(residual)
            jacobians.append(block)

        if self.free.poses:
            for prior, pose in (
                (self.camera_prior, state.camera_pose),
                (self.board_prior, state.board_pose),
            ):
                if prior is not None:
                    add(*prior.whitened(pose))
                place += 6
        if self.free.scale:
            add(np.array([state.log_scale / SCALE_SIGMA]), np.array([[1.0 / SCALE_SIGMA]]))
            place += 1
        if self.free.warp:
            sigma = WARP_SIGMA * float(self.sheet.half.max())
            add(state.warp / sigma, np.eye(3) / sigma)
        return np.concatenate(residuals), np.concatenate(jacobians)

    def retract(self, state: ChainState, by_globals: Array, by_locals: Array) -> ChainState:
        free, used = self.free, len(self.free.intrinsics)
        step, log_scale, warp = by_globals[used:], state.log_scale, state.warp
        camera_pose, board_pose = state.camera_pose, state.board_pose
        if free.poses:
            moves = pose_matrices(step[:12].reshape(2, 6))
            camera_pose, board_pose, step = camera_pose @ moves[0], board_pose @ moves[1], step[12:]
        if free.scale:
            log_scale, step = log_scale + float(step[0]), step[1:]
        if free.warp:
            warp = warp + step
        return ChainState(
            camera=_moved_camera(state.camera, free.intrinsics, by_globals[:used]),
            camera_pose=camera_pose,
            board_pose=board_pose,
            corrections=_moved(state.corrections, by_locals),
            log_scale=log_scale,
            warp=warp,
        )

    def subset(self, index: Mask | Array) -> Chain:
        """The same problem over some of its views."""
        return replace(
            self, batch=self.batch[index], before=self.before[index], after=self.after[index]
        )


def _apply(poses: Array, points: Array) -> Array:
    """Points (n, k, 3) mapped by poses (n, 4, 4)."""
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def _moved(poses: Array, steps: Array) -> Array:
    return poses @ pose_matrices(steps) if steps.size else poses


def _moved_camera(camera: CameraModel, free: tuple[int, ...], step: Array) -> CameraModel:
    if not free:
        return camera
    vector = camera.vector
    vector[list(free)] += step
    vector[:2] = np.maximum(vector[:2], 1.0)
    return CameraModel.from_vector(vector, camera.image_size)
