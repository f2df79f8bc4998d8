"""Fitting camera and projector to captures: noise from the data, captures that do not belong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import Chain, ChainState, Free, Sheet
from cellctl.calib.pose import board_pose
from cellctl.calib.procam_problem import (
    Capture,
    Captures,
    Noise,
    Plausible,
    Procam,
    ProcamFree,
    ProcamState,
)
from cellctl.calib.procam_start import starts
from cellctl.calib.schur import Solution, minimise
from cellctl.calib.views import Batch, Rejection, View, noise_px, rms
from cellctl.errors import SolveError
from cellctl.geometry import Array, transform_points

HUBER = 4.0
ROUNDS = 4
ITERATIONS, FEW = 100, 12
"""Two captures leave flat valleys: an adjustment that is stopped early ends far from the bottom,
most of all that of a projector with lens shift. A few tell which start is the best."""
PINHOLE, LENS = (0, 1, 2, 3), (0, 1, 2, 3, 4, 5, 6, 7)
"""Places in camera.INTRINSICS: without, and with, k1 k2 p1 p2."""
PINHOLES = ProcamFree(PINHOLE, PINHOLE, pose=True)
OPTIONS = (ProcamFree(LENS, LENS, pose=True), ProcamFree(LENS, LENS, pose=True, warp=True))
"""Simplest first."""
CENTRE, RADIAL, TANGENTIAL, ASPECT = 0.05, (0.2, 0.3, 0.3), 0.003, 0.001
"""How far lenses are from the ideal, before the data are asked: a camera's principal point, in
widths of its picture from its middle; k1 k2 k3; p1 p2; fx / fy from one. Pixels are square, but
for a projector that stretches its input: then the data contradict, and `aspect` is left to them."""
CONTRADICTED = 3.0
BULGE, LEAST_BULGE = 1e-3, 1e-5
"""How far a board's points are off its plane, in its longer sides: at first, and at least."""
LEAST_READING = 0.03
"""Projector px: no model of a lens is truer, however well the code was read."""
FAR, FAR_PX = 4.0, 1.0
"""A capture does not belong to the others when the error without it is so many times smaller, and
with it so many projector pixels."""


@dataclass(frozen=True, eq=False)
class ProcamFit:
    """Camera and projector fitted to `captures`."""

    captures: list[Capture]
    problem: Procam
    noise: Noise
    solution: Solution[ProcamState]

    @property
    def state(self) -> ProcamState:
        return self.solution.state

    def errors(self) -> tuple[list[Array], list[Array]]:
        """Errors (k, 2) of each capture, in camera pixels and in projector pixels."""
        seen = self.problem.seen.seen
        camera, projector = self.problem.errors(self.state)
        return (
            [error[s] for error, s in zip(camera, seen, strict=True)],
            [error[s] for error, s in zip(projector, seen, strict=True)],
        )

    def sigmas(self) -> tuple[Array, Array]:
        """Standard deviations (9,) of the camera's and the projector's parameters."""
        free, both = self.problem.free, np.zeros((2, 9))
        variances = self.solution.globals_covariance.diagonal()
        count = len(free.camera)
        both[0, list(free.camera)] = np.sqrt(variances[:count])
        both[1, list(free.projector)] = np.sqrt(variances[count : count + len(free.projector)])
        return both[0], both[1]

    def adjusted(self, free: ProcamFree) -> ProcamFit:
        """From here with other unknowns, and the noise estimated again."""
        fit = replace(self, problem=replace(self.problem, free=free))
        for _ in range(ROUNDS):
            fit = fit.settled(fit.noise)
            fit = replace(fit, noise=_noise(fit))
        return fit.settled(fit.noise)

    def settled(self, noise: Noise, iterations: int = ITERATIONS) -> ProcamFit:
        """The least cost with noise such as this, or what so many iterations make of it."""
        problem = self.problem.whitened_at(self.state, noise)
        solution = minimise(
            problem, self.state, huber=HUBER, max_iterations=iterations, tolerance=1e-8
        )
        return ProcamFit(self.captures, problem, noise, solution)

    def without(self, capture_id: str) -> ProcamFit:
        """Fitted again without one capture, from here and with the same noise."""
        keep = np.array([capture.id != capture_id for capture in self.captures])
        captures = [capture for capture in self.captures if capture.id != capture_id]
        state = replace(self.state, boards=self.state.boards[keep])
        problem = replace(
            self.problem, seen=Captures.of(captures), whitening=self.problem.whitening[keep]
        )
        fit = ProcamFit(captures, problem, self.noise, replace(self.solution, state=state))
        return fit.settled(self.noise).settled(self.noise)

    def held_out(self, captures: Sequence[Capture]) -> list[Array]:
        """Errors (k, 2) in projector pixels of each capture under a fit that never saw it."""
        used = {capture.id for capture in self.captures}
        return [
            prediction_errors(self.without(c.id) if c.id in used else self, c) for c in captures
        ]


def prediction_errors(fit: ProcamFit, capture: Capture) -> Array:
    """Errors (k, 2), projector px: the board's pose is fitted to the camera's corners alone. None,
    (0, 2), of a capture whose points do not fix a pose."""
    state = fit.state
    return predicted(
        state.camera, state.projector, state.pose, capture, state.warp, fit.problem.sheet
    )


def predicted(
    camera: CameraModel,
    projector: CameraModel,
    pose: Array,
    capture: Capture,
    warp: Array,
    sheet: Sheet,
) -> Array:
    """As `prediction_errors`, of a board with that warp."""
    view = View(capture.id, capture.points, capture.camera_px)
    try:
        start = board_pose(view, camera).matrix
    except SolveError:
        return np.zeros((0, 2))
    one = np.eye(4)[None]
    chain = Chain(Batch.of([view]), one, one, sheet, Free())
    state = ChainState(camera, np.eye(4), np.eye(4), start[None], warp=warp)
    in_camera = chain.points(minimise(chain, state).state)[0]
    return projector.project(transform_points(pose, in_camera)) - capture.projector_px


def belonging(
    captures: Sequence[Capture], image_size: tuple[int, int], size: tuple[int, int]
) -> tuple[ProcamFit, list[Rejection]]:
    """A fit of the captures that agree with each other, and the others with the reason: without
    the one that does not belong the error falls, whichever other is left out it does not.

    SolveError when no camera and projector explain them.
    """
    kept, rejected = list(captures), []
    fit = _from_scratch(kept, image_size, size)
    while len(kept) > 2 and (error := _error(fit)) > FAR_PX:
        fits = [_from_scratch([c for c in kept if c is not one], image_size, size) for one in kept]
        best = int(np.argmin([_error(rest) for rest in fits]))
        if _error(fits[best]) * FAR > error:
            break
        reason = (
            f"does not belong to the other captures: with it the error is {error:.1f} projector "
            f"px, without it {_error(fits[best]):.2f}; was it mislabelled, or did camera or "
            "projector move?"
        )
        rejected.append(Rejection(kept[best].id, reason))
        fit, kept = fits[best], fits[best].captures
    return _square_or_not(fit), rejected


def _square_or_not(fit: ProcamFit) -> ProcamFit:
    """With an aspect that is free where the data contradict square pixels."""
    problem, changed = fit.problem, {}
    for name in ("camera", "projector"):
        fx, fy = getattr(fit.state, name).vector[:2]
        if abs(np.log(fx / fy)) > CONTRADICTED * ASPECT:
            changed[name] = replace(getattr(problem, name), aspect=1.0)
    return replace(fit, problem=replace(problem, **changed)).settled(fit.noise)


def _error(fit: ProcamFit) -> float:
    return rms(np.concatenate(fit.errors()[1]))


def _from_scratch(
    captures: list[Capture], image_size: tuple[int, int], size: tuple[int, int]
) -> ProcamFit:
    """The best fit over all starts, as pinholes first."""
    sheet = Sheet.of(np.concatenate([capture.points for capture in captures]))
    seen = Captures.of(captures)
    blank = np.broadcast_to(np.eye(4), (*seen.seen.shape, 4, 4))
    lenses = plausible(image_size, CENTRE), plausible(size, None)
    problem = Procam(seen, sheet, PINHOLES, *lenses, blank)
    noise = Noise(camera=0.2, projector=0.1, lift=BULGE * 2.0 * float(sheet.half.max()))
    fits = []
    for start in starts(captures, image_size, size):
        if np.isfinite(problem.residuals(start)).all():
            begin = Solution(problem, start, HUBER, np.inf, 0, converged=False)
            fits.append(ProcamFit(captures, problem, noise, begin).settled(noise, FEW))
    if not fits:
        raise SolveError("no camera and projector in front of the board explain the captures")
    best = min(fits, key=lambda fit: fit.solution.cost)
    full = replace(best, problem=replace(best.problem, free=OPTIONS[0]))
    return full.settled(noise, 3 * FEW)


def plausible(size: tuple[int, int], centre: float | None) -> Plausible:
    """A lens for pictures of `size` (w, h); its principal point within `centre` widths of the
    middle, or anywhere."""
    w, h = size
    anything = 1e3 * w
    off = anything if centre is None else centre * w
    k1, k2, k3 = RADIAL
    return Plausible(
        mean=np.array([w, w, (w - 1) / 2, (h - 1) / 2, 0.0, 0.0, 0.0, 0.0, 0.0]),
        sigma=np.array([anything, anything, off, off, k1, k2, TANGENTIAL, TANGENTIAL, k3]),
        aspect=ASPECT,
    )


def _noise(fit: ProcamFit) -> Noise:
    """From the medians of the errors: the reading's across epipolar lines, where no lift of a
    point shows, and the bulge from what is left along them."""
    problem, seen = fit.problem, fit.problem.seen
    camera, projector = problem.errors(fit.state)
    beyond = (projector - (seen.slopes @ camera[..., None])[..., 0])[seen.seen]
    parallax = problem.by_lift(fit.state)[seen.seen][:, 2:, 0]
    size = np.linalg.norm(parallax, axis=1)
    along = parallax / np.maximum(size, 1e-12)[:, None]
    across = beyond[:, 0] * along[:, 1] - beyond[:, 1] * along[:, 0]
    reading = 1.4826 * float(np.median(np.abs(across)))
    spread = 1.4826 * float(np.median(np.abs((beyond * along).sum(axis=1))))
    lift = np.sqrt(max(spread**2 - reading**2, 0.0)) / max(float(np.median(size)), 1e-9)
    longest = 2.0 * float(problem.sheet.half.max())
    lift = float(np.clip(lift, LEAST_BULGE * longest, 10.0 * BULGE * longest))
    return Noise(noise_px(camera[seen.seen]), max(reading, LEAST_READING), lift)
