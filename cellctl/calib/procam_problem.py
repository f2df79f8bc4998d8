"""Camera, projector and boards adjusted together: the problem for the arrow solver.

    x_camera = B_i q,   x_projector = T_projector_camera B_i q

q is the printed point, lifted by the board's warp as in chain.py. A projector is a camera that
shows instead of sees, with the same model. Two things make errors of its pixels and of the
camera's depend on each other:

- The projector's pixel is read off where the camera saw the corner, so an error e of the corner
  moves it by S e, S the slope of the map from picture to picture. The reading itself is ten times
  as precise as the corner.
- Paper that was glued to a board bulges, differently each time. A point that is lifted off the
  plane moves in both pictures, along epipolar lines. Taken for noise of the reading, it would
  drag the lenses along; with a standard deviation of its own only what is across those lines
  counts in full.

With g the derivatives of (e, projector's error - S e) by the lift, the four errors of a point have
the covariance diag(c^2, c^2, p^2, p^2) + l^2 g g^T, by which they are whitened.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import WARP_SIGMA, Sheet
from cellctl.calib.pose import derivatives_by_pose, pose_matrices
from cellctl.calib.schur import Linearised, Priors
from cellctl.geometry import Array, Mask


@dataclass(frozen=True, eq=False)
class Capture:
    """One board as camera and projector have it: `points` (n, 3) on it, metres, `camera_px` and
    `projector_px` (n, 2), and the `slopes` (n, 2, 2) of the latter by the former."""

    id: str
    points: Array
    camera_px: Array
    projector_px: Array
    slopes: Array

    def __getitem__(self, index: Mask) -> Capture:
        return Capture(
            self.id, self.points[index], self.camera_px[index], self.projector_px[index],
            self.slopes[index],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Captures:
    """Captures side by side: `points` (n, k, 3), pixels (n, k, 2), `slopes` (n, k, 2, 2), `seen`
    (n, k)."""

    points: Array
    camera_px: Array
    projector_px: Array
    slopes: Array
    seen: Mask

    @classmethod
    def of(cls, captures: list[Capture]) -> Captures:
        n, k = len(captures), max(len(capture.points) for capture in captures)
        points, seen = np.zeros((n, k, 3)), np.zeros((n, k), dtype=bool)
        pixels, slopes = np.zeros((2, n, k, 2)), np.zeros((n, k, 2, 2))
        for i, capture in enumerate(captures):
            m = len(capture.points)
            points[i, :m], seen[i, :m], slopes[i, :m] = capture.points, True, capture.slopes
            pixels[0, i, :m], pixels[1, i, :m] = capture.camera_px, capture.projector_px
        return cls(points, pixels[0], pixels[1], slopes, seen)


@dataclass(frozen=True, eq=False)
class ProcamState:
    """Unknowns: both devices, `pose` T_projector_camera and `boards` T_camera_board (n, 4, 4),
    and the boards' common `warp` (3,), metres (chain.Sheet)."""

    camera: CameraModel
    projector: CameraModel
    pose: Array
    boards: Array
    warp: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class ProcamFree:
    """What may change beside the boards: places in camera.INTRINSICS, the pose, the warp."""

    camera: tuple[int, ...] = ()
    projector: tuple[int, ...] = ()
    pose: bool = False
    warp: bool = False

    @property
    def count(self) -> int:
        return len(self.camera) + len(self.projector) + 6 * self.pose + 3 * self.warp


@dataclass(frozen=True, eq=False)
class Plausible:
    """What is known of a lens before it is calibrated: `mean` and standard deviations `sigma`
    (9,) in the order of camera.INTRINSICS, and how far fx / fy is from one, `aspect`.

    Two or three captures leave combinations of the parameters almost free; without this they run
    away, and what was never seen is predicted by pixels too far.
    """

    mean: Array
    sigma: Array
    aspect: float

    def whitened(self, lens: CameraModel, free: tuple[int, ...]) -> tuple[Array, Array]:
        """Residuals (m,) of a lens and their derivatives (m, f) by its `free` parameters."""
        residuals = (lens.vector - self.mean) / self.sigma
        slopes = np.diag(1.0 / self.sigma)
        fx, fy = lens.vector[:2]
        aspect = np.zeros(9)
        aspect[:2] = np.array([1.0 / fx, -1.0 / fy]) / self.aspect
        residuals = np.append(residuals, np.log(fx / fy) / self.aspect)
        return residuals, np.vstack([slopes, aspect])[:, list(free)]


@dataclass(frozen=True)
class Noise:
    """Standard deviations: of a coordinate of a corner, camera px; of the reading of a projector
    pixel there, projector px; and of how far a point is off its board's plane, metres."""

    camera: float = 0.1
    projector: float = 0.05
    lift: float = 1e-3


@dataclass(frozen=True, eq=False)
class Procam:
    """A least-squares problem (schur.Problem). `whitening` (n, k, 4, 4) goes with the state for
    which it was made: see `whitened_at`."""

    seen: Captures
    sheet: Sheet
    free: ProcamFree
    camera: Plausible
    projector: Plausible
    whitening: Array

    @cached_property
    def lift(self) -> Array:
        return self.sheet.lift(self.seen.points)

    def printed(self, state: ProcamState) -> Array:
        """Board points (n, k, 3) where they truly are on the board."""
        points = self.seen.points.copy()
        points[..., 2] += self.lift @ state.warp
        return points

    def errors(self, state: ProcamState) -> tuple[Array, Array]:
        """(n, k, 2) each, of the camera's and the projector's pixels; zero where nothing was
        seen, not-a-number for what would lie behind a lens."""
        in_camera = _apply(state.boards, self.printed(state))
        in_projector = in_camera @ state.pose[:3, :3].T + state.pose[:3, 3]
        seen = self.seen.seen[..., None]
        camera = state.camera.project(in_camera) - self.seen.camera_px
        projector = state.projector.project(in_projector) - self.seen.projector_px
        return np.where(seen, camera, 0.0), np.where(seen, projector, 0.0)

    def residuals(self, state: ProcamState) -> Array:
        camera, projector = self.errors(state)
        return self._independent(camera[..., None], projector[..., None])[..., 0]

    def _independent(self, camera: Array, projector: Array) -> Array:
        """(n, 2 k, 2, m), whitened, of errors or derivatives (n, k, 2, m) of both."""
        both = np.concatenate([camera, projector - self.seen.slopes @ camera], axis=2)
        white = self.whitening @ both
        return np.concatenate([white[:, :, :2], white[:, :, 2:]], axis=1)

    def whitened_at(self, state: ProcamState, noise: Noise) -> Procam:
        """The same problem with noise such as this, its parallax as it is at `state`."""
        g = self.by_lift(state)
        variances = np.square([noise.camera, noise.camera, noise.projector, noise.projector])
        covariance = np.diag(variances) + noise.lift**2 * g @ np.swapaxes(g, 2, 3)
        return replace(self, whitening=np.linalg.inv(np.linalg.cholesky(covariance)))

    def by_lift(self, state: ProcamState) -> Array:
        """(n, k, 4, 1): derivatives of the camera's error, and of the projector's beyond it, by
        a lift of the point off its board."""
        in_camera = _apply(state.boards, self.printed(state))
        in_projector = in_camera @ state.pose[:3, :3].T + state.pose[:3, 3]
        normal = state.boards[:, None, :3, 2:3]
        seen = state.camera.jacobians(in_camera, intrinsics=False)[1] @ normal
        shown = state.projector.jacobians(in_projector, intrinsics=False)[1]
        shown = shown @ state.pose[:3, :3] @ normal
        return np.concatenate([seen, shown - self.seen.slopes @ seen], axis=2)

    def linearise(self, state: ProcamState) -> Linearised:
        on_board = self.printed(state)
        in_camera = _apply(state.boards, on_board)
        R, seen = state.pose[:3, :3], self.seen.seen[..., None]
        in_projector = in_camera @ R.T + state.pose[:3, 3]
        pixels, by_point, by_camera = state.camera.jacobians(in_camera)
        shown, by_shown, by_projector = state.projector.jacobians(in_projector)
        by_moved = by_shown @ R
        free, none = self.free, np.zeros_like(by_camera)
        pose = derivatives_by_pose(by_moved, in_camera)[..., : 6 * free.pose]
        sides = [
            [by_camera[..., list(free.camera)], none[..., list(free.projector)], 0.0 * pose],
            [none[..., list(free.camera)], by_projector[..., list(free.projector)], pose],
        ]
        for side, by in zip(sides, (by_point, by_moved), strict=True):
            by_printed = by @ state.boards[:, None, :3, :3]
            if free.warp:
                side.append(by_printed[..., 2:] * self.lift[..., None, :])
            side.append(derivatives_by_pose(by_printed, on_board))
        both = [np.concatenate(side, axis=-1) * seen[..., None] for side in sides]
        off = [(pixels - self.seen.camera_px) * seen, (shown - self.seen.projector_px) * seen]
        columns = self._independent(*both)
        return Linearised(
            residuals=self._independent(*(o[..., None] for o in off))[..., 0],
            by_globals=columns[..., : free.count],
            by_locals=columns[..., free.count :],
        )

    def priors(self, state: ProcamState) -> Priors:
        """Of both lenses and of the warp."""
        n, free = len(state.boards), self.free
        sigma = WARP_SIGMA * float(self.sheet.half.max())
        parts = [
            self.camera.whitened(state.camera, free.camera),
            self.projector.whitened(state.projector, free.projector),
            (np.zeros(0), np.zeros((0, 6 * free.pose))),
            (state.warp / sigma, np.eye(3, 3 * free.warp) / sigma),
        ]
        return Priors(
            np.concatenate([residuals for residuals, _ in parts]),
            block_diag(*(slopes for _, slopes in parts)),
            np.zeros((n, 0)),
            np.zeros((n, 0, 6)),
        )

    def retract(self, state: ProcamState, by_globals: Array, by_locals: Array) -> ProcamState:
        free = self.free
        ends = np.cumsum([len(free.camera), len(free.projector), 6 * free.pose])
        camera, projector, pose, warp = np.split(by_globals, ends)
        return ProcamState(
            camera=moved(state.camera, free.camera, camera),
            projector=moved(state.projector, free.projector, projector),
            pose=state.pose @ pose_matrices(pose[None])[0] if free.pose else state.pose,
            boards=state.boards @ pose_matrices(by_locals),
            warp=state.warp + warp if free.warp else state.warp,
        )


def _apply(poses: Array, points: Array) -> Array:
    """Points (n, k, 3) mapped by poses (n, 4, 4)."""
    return points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]


def moved(lens: CameraModel, free: tuple[int, ...], step: Array) -> CameraModel:
    """With its parameters at the places `free` changed by a step; focal lengths stay positive."""
    vector = lens.vector
    vector[list(free)] += step
    vector[:2] = np.maximum(vector[:2], 1.0)
    return CameraModel.from_vector(vector, lens.image_size)
