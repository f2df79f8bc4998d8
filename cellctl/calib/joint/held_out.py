"""How the joint adjustment predicts circles that it has not seen, and as a candidate beside the
corrections of `refine`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.joint.observations import Circles
from cellctl.calib.joint.pictures import pen
from cellctl.calib.joint.result import JointResult
from cellctl.calib.refine_fit import Fit, Marks, rotations
from cellctl.calib.refine_result import Candidate
from cellctl.calib.refinement import Refinement
from cellctl.calib.schur import inverse_of
from cellctl.errors import SolveError
from cellctl.geometry import Array, Mask

NAME = "joint adjustment"


def predict(result: JointResult, circles: Circles) -> Array:
    """Camera pixels (n, 2) where circles are to be seen."""
    problem, state = result.problem, result.state
    turn = rotations(circles.yaw)
    picture = pen(state, problem.look, problem.field, circles.xy, turn)
    flat = np.column_stack([picture.xy, np.ones(len(circles))])
    return state.camera.project(flat)


def held_out_pixels(result: JointResult, folds: Array) -> Array:
    """Camera pixels (n, 2, s) of the result's circles, each predicted by an adjustment without
    the circles of its fold; folds (s, n) number them in s ways.

    Taking rows out of the normal equations moves the unknowns by (S - A^T A)^-1 A^T r: exact for
    a linear problem, which this one is at the size of such a step, the noises being kept.
    """
    whole, weighted = _circle_rows(result)
    S = inverse_of(result.covariance)
    A, r = weighted
    predicted = np.empty((len(result.seen.circles), 2, len(folds)))
    for way, fold in enumerate(folds):
        for number in np.unique(fold):
            out = fold == number
            rows = A[out].reshape(-1, A.shape[-1])
            moved = np.linalg.solve(S - rows.T @ rows, rows.T @ r[out].reshape(-1))
            predicted[out, :, way] = whole[1][out] + whole[0][out] @ moved
    millimetres = predicted * result.problem.sigma["draw"]
    off = np.linalg.inv(result.problem.mm) @ millimetres
    return np.asarray(result.seen.circles.pixels[..., None] + off)


def joint_candidate(
    result: JointResult, marks: Marks, used: Mask, base: Calibration, folds: Array
) -> Candidate:
    """For `refine.choose`: measured on all `marks`, of which the result's circles are those that
    are `used` (n,), in the same order; `folds` (s, n') as refine.rows has them. Errors are those
    in the base's camera coordinates, as for the other candidates.

    SolveError when the circles are not those.
    """
    names = tuple(key for key, ok in zip(marks.keys, used, strict=True) if ok)
    if names != result.seen.circles.keys:
        raise SolveError("the joint adjustment rests on other circles than those to be compared")
    fit = JointFit.of(result, base)
    everything = fit.predict(marks)
    ways = {"one": np.arange(len(names))[None], "row": folds}
    held_out = {}
    for name, numbers in ways.items():
        predicted = np.repeat(everything[..., None], len(numbers), axis=2)
        pixels = np.moveaxis(held_out_pixels(result, numbers), 2, 0)
        seen = [base.camera.normalise(one) for one in pixels]
        predicted[used] = np.stack(seen, axis=2)
        held_out[name] = predicted
    return Candidate.measured(NAME, 1.0, fit, held_out, marks, used, base)


@dataclass(frozen=True, eq=False)
class JointFit(Fit):
    """A joint adjustment where a fit of a correction is wanted. It predicts in the coordinates of
    `base`; its refinement goes with its own camera, pose and table, those of
    result.calibration."""

    result: JointResult | None = None
    base: Calibration | None = None

    @classmethod
    def of(cls, result: JointResult, base: Calibration) -> JointFit:
        refinement = result.calibration.refinement or Refinement("none")
        covariance = 1e6 * result.covariance_of("tcp")
        normal = np.linalg.inv(covariance) * result.sigma["draw"] ** 2
        count, nothing = len(result.seen.circles), np.zeros(2)
        return cls(refinement, result.state.tcp, normal, nothing, count, None, result, base)

    @property
    def freedom(self) -> float:
        assert self.result is not None
        return self.result.components["draw"].redundancy

    def predict(self, marks: Marks) -> Array:
        assert self.result is not None
        assert self.base is not None
        yaw = np.arctan2(marks.turn[:, 1, 0], marks.turn[:, 0, 0] + 1.0)
        circles = Circles(marks.keys, marks.xy, yaw, np.zeros((len(marks), 2)))
        return self.base.camera.normalise(predict(self.result, circles))


def _circle_rows(result: JointResult) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivatives (n, 2, g) and residuals (n, 2) of the circles in standard deviations, plain and
    with the weights that Huber's loss gave them."""
    part = result.problem.global_parts(result.state)["draw"]
    found = []
    for one in (part, part.weighted(result.solution.huber)):
        wide = np.zeros((*one.residuals.shape[1:], result.layout.count))
        wide[..., one.columns] = one.by_globals[0]
        found.append((wide, one.residuals[0]))
    return found[0], found[1]
