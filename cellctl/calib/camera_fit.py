"""Fitting a camera to views of a flat board: starts, adjustment, and views that do not belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import FULL, PINHOLE, Chain, ChainState, Free, Sheet
from cellctl.calib.pose import BoardPose, board_poses, on_a_line
from cellctl.calib.schur import Solution, minimise
from cellctl.calib.views import AnyView, Batch, Rejection, View, noise_px, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

MINIMUM_VIEWS = 3
MINIMUM_POINTS = 6
HUBER = 4.0
"""Residuals lose weight beyond so many standard deviations: 3e-4 of honest noise does."""
FAR_BEYOND, FAR_SIGMAS, FAR_PX = 3.0, 5.0, 0.1
"""A view is rejected when its error is that many times the median view's, that many robust
standard deviations above it, and that many pixels."""
NO_POSE = "no pose of the board explains the picture"
NEED = f"views of the board; a camera needs at least {MINIMUM_VIEWS}, tilted in different ways"
FOCAL_GUESSES = (0.6, 1.0, 1.7, 3.0)
"""In longer sides of the picture, tried beside the closed form."""


@dataclass(frozen=True)
class CameraOption:
    """What is fitted beside focal lengths, principal point and the boards' poses: five
    coefficients of `distortion`, and the `warp` of the board."""

    distortion: bool = True
    warp: bool = True

    @property
    def free(self) -> Free:
        return Free(intrinsics=FULL if self.distortion else PINHOLE, warp=self.warp)


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera fitted to `chain`'s views, which are `names`."""

    names: tuple[str, ...]
    chain: Chain
    solution: Solution[ChainState]

    @property
    def state(self) -> ChainState:
        return self.solution.state

    @property
    def camera(self) -> CameraModel:
        return self.solution.state.camera

    @property
    def sigma_px(self) -> float:
        """Robust noise of a coordinate of a corner."""
        return self.chain.sigma_px

    @property
    def sigma(self) -> Array:
        """Standard deviations (9,) of camera.vector, from the scatter of the errors."""
        free = self.chain.free
        errors = self.chain.errors(self.state)[self.chain.batch.seen]
        redundancy = errors.size - free.count - 6 * len(self.names)
        variance = np.square(errors).sum() / max(redundancy, 1) / self.sigma_px**2
        count, sigma = len(free.intrinsics), np.zeros(9)
        variances = self.solution.globals_covariance.diagonal()[:count]
        sigma[list(free.intrinsics)] = np.sqrt(variance * variances)
        return sigma

    def rescaled(self, factor: float) -> CameraFit:
        """The same fit to a board of another size: only lengths change."""
        batch, sheet = self.chain.batch, self.chain.sheet
        chain = replace(
            self.chain,
            batch=Batch(factor * batch.points, batch.pixels, batch.seen),
            sheet=Sheet(factor * sheet.centre, factor * sheet.half),
        )
        poses = self.state.corrections.copy()
        poses[:, :3, 3] *= factor
        state = replace(self.state, corrections=poses, warp=factor * self.state.warp)
        return CameraFit(self.names, chain, replace(self.solution, problem=chain, state=state))

    def without(self, view: int) -> CameraFit:
        """Fitted again without one view, from here."""
        return self.over(np.arange(len(self.names)) != view)

    def over(self, keep: Mask) -> CameraFit:
        """Fitted again over some of the views, from here and with the same noise."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        chain = self.chain.subset(keep)
        start = replace(self.state, corrections=self.state.corrections[keep])
        return CameraFit(names, chain, minimise(chain, start, huber=HUBER, tolerance=1e-7))


def fit_camera(
    views: Sequence[View],
    image_size: tuple[int, int],
    option: CameraOption,
    minimum_points: int = MINIMUM_POINTS,
) -> tuple[CameraFit, list[Rejection]]:
    """The camera fitted to all views that agree, and the others with the reason.

    SolveError when fewer than three views are left, or when no camera explains them.
    """
    usable, rejected = usable_views(views, minimum_points)
    while True:
        require_views(usable, rejected, NEED)
        camera, poses = start_camera(usable, image_size)
        bad = {view.id: NO_POSE for view in usable if view.id not in poses}
        if not bad:
            fit = _fit(usable, camera, np.stack([poses[view.id] for view in usable]), option)
            bad = _far_beyond(fit)
        if not bad:
            return fit, sorted(rejected, key=lambda r: r.id)
        rejected += [Rejection(name, reason) for name, reason in bad.items()]
        usable = [view for view in usable if view.id not in bad]


def usable_views(views: Sequence[AnyView], minimum: int) -> tuple[list[AnyView], list[Rejection]]:
    """Views from which a pose of the board can be told, and the others."""
    usable: list[AnyView] = []
    rejected: list[Rejection] = []
    for view in views:
        if len(view.points) < minimum:
            reason = f"only {len(view.points)} points of the board seen, {minimum} needed"
            rejected.append(Rejection(view.id, reason))
        elif on_a_line(view.points):
            rejected.append(Rejection(view.id, "all points seen lie on one line of the board"))
        else:
            usable.append(view)
    return usable, rejected


def require_views(views: Sequence[View], rejected: Sequence[Rejection], need: str) -> None:
    """SolveError with the `need` in words, and why others were rejected, below MINIMUM_VIEWS."""
    if len(views) < MINIMUM_VIEWS:
        why = "".join(f"; {r.id}: {r.reason}" for r in rejected[:5])
        raise SolveError(f"{len(views)} usable {need}{why}")


def _fit(
    views: Sequence[View], camera: CameraModel, poses: Array, option: CameraOption
) -> CameraFit:
    ones = np.broadcast_to(np.eye(4), poses.shape)
    sheet = Sheet.of(np.concatenate([view.points for view in views]))
    chain = Chain(Batch.of(views), ones, ones, sheet, option.free)
    state = ChainState(camera, np.eye(4), np.eye(4), poses)
    for _ in range(3):
        chain = replace(chain, sigma_px=noise_px(chain.errors(state)[chain.batch.seen]))
        solution = minimise(chain, state, huber=HUBER)
        state = solution.state
    return CameraFit(tuple(view.id for view in views), chain, solution)


def start_camera(
    views: Sequence[View], image_size: tuple[int, int]
) -> tuple[CameraModel, dict[str, Array]]:
    """A pinhole, and T_camera_board by the ids of the views that it explains.

    Zhang's closed form, or a common focal length if noise or one bad view spoils that; whichever
    explains the median view best.
    """
    guesses = _zhang(views, image_size) + [factor * max(image_size) for factor in FOCAL_GUESSES]
    cameras = [_pinhole(focal, image_size) for focal in guesses]
    batch, maps = Batch.of(views), _homographies(views)
    errors = [float(np.median(_by_homography(batch, maps, camera))) for camera in cameras]
    best = int(np.argmin(errors))
    if not np.isfinite(errors[best]):
        raise SolveError("no pinhole camera explains the views of the board, not even roughly")
    found = {view.id: pose for view in views if (pose := _rough(view, cameras[best]))}
    return cameras[best], {name: pose.matrix for name, pose in found.items()}


def _homographies(views: Sequence[View]) -> Array:
    """(n, 3, 3) from the board's plane to the picture; not-a-number where there is none."""
    maps = np.full((len(views), 3, 3), np.nan)
    for i, view in enumerate(views):
        middle, spread = view.points[:, :2].mean(axis=0), np.ptp(view.points[:, :2])
        scaled = (view.points[:, :2] - middle) / spread  # OpenCV works in single precision
        found, _ = cv2.findHomography(scaled, view.pixels)
        if found is not None:
            maps[i] = found @ np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, spread]])
    return maps


def _by_homography(batch: Batch, maps: Array, camera: CameraModel) -> Array:
    """Reprojection errors (n,), rms px, of the poses that homographies (n, 3, 3) contain for a
    pinhole camera, infinite where there is none: Z. Zhang, 2000, section 3.1 and appendix C."""
    rays = np.linalg.inv(camera.K) @ maps
    lengths = np.linalg.norm(rays[:, :, :2], axis=1).mean(axis=1)
    rays = rays / (lengths * np.sign(rays[:, 2, 2]))[:, None, None]
    known = np.isfinite(rays).all(axis=(1, 2))
    rays[~known] = np.eye(3)
    across = np.cross(rays[:, :, 0], rays[:, :, 1])
    u, _, vt = np.linalg.svd(np.stack([rays[:, :, 0], rays[:, :, 1], across], axis=-1))
    points = batch.points @ np.swapaxes(u @ vt, 1, 2) + rays[:, None, :, 2]
    off = np.where(batch.seen[..., None], camera.project(points) - batch.pixels, 0.0)
    errors = np.sqrt(np.square(off).sum(axis=(1, 2)) / batch.seen.sum(axis=1))
    return np.where(known & np.isfinite(errors), errors, np.inf)


def _rough(view: View, camera: CameraModel) -> BoardPose | None:
    try:
        return board_poses(view, camera, refine=False)[0]
    except SolveError:
        return None


def _zhang(views: Sequence[View], image_size: tuple[int, int]) -> list[float]:
    """Focal length from the homographies (Z. Zhang, 2000), if they yield a sensible one."""
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        focal = float(cv2.initCameraMatrix2D(points, pixels, image_size, 1.0)[0, 0])
    except cv2.error:  # OpenCV finds no homography in single precision
        return []
    return [focal] if 0.1 < focal / max(image_size) < 100.0 else []


def _pinhole(focal: float, image_size: tuple[int, int]) -> CameraModel:
    w, h = image_size
    K = np.array([[focal, 0.0, (w - 1) / 2], [0.0, focal, (h - 1) / 2], [0.0, 0.0, 1.0]])
    return CameraModel(K, np.zeros(5), image_size)


def _far_beyond(fit: CameraFit) -> dict[str, str]:
    """The worst view by its id and what is wrong with it; empty when all belong together."""
    errors, seen = fit.chain.errors(fit.state), fit.chain.batch.seen
    per_view = np.array([rms(e[s]) for e, s in zip(errors, seen, strict=True)])
    median = float(np.median(per_view))
    spread = 1.4826 * float(np.median(np.abs(per_view - median)))
    worst = int(np.argmax(per_view))
    if per_view[worst] <= max(FAR_BEYOND * median, median + FAR_SIGMAS * spread, FAR_PX):
        return {}
    reason = f"reprojection error {per_view[worst]:.2f} px; the median view has {median:.2f} px"
    return {fit.names[worst]: reason}
