"""The joint adjustment of everything that was seen."""

from __future__ import annotations

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.joint.noise import components, sigmas
from cellctl.calib.joint.observations import Observations
from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.result import JointResult
from cellctl.calib.joint.start import JointOptions, begin
from cellctl.calib.joint.state import JointState
from cellctl.calib.schur import Solution, minimise
from cellctl.calib.table_surface import Area

HUBER = 4.0
ROUNDS, SETTLED = 6, 0.03
"""Noises are estimated so often at most, or until none changes by more than that part."""
ALL = JointOptions()


def solve_joint(
    seen: Observations,
    start: Calibration,
    *,
    options: JointOptions = ALL,
    area: Area | None = None,
) -> JointResult:
    """Adjust all that `options` leave free to `seen`, from a calibration that is roughly right.

    `area` is where the result counts, by default what was drawn in and a margin of 10 %. The
    start's refinement is ignored. BadInput for what does not fit together; SolveError when
    something has no start.
    """
    problem, state = begin(seen, start, options, area)
    solution = _settled(problem, state)
    return JointResult(seen, start, solution)


def _settled(problem: JointProblem, state: JointState) -> Solution[JointState]:
    """Adjusted with noises that its own residuals ask for."""
    solution = minimise(problem, state, huber=HUBER, tolerance=1e-3)
    for _ in range(ROUNDS):
        new = sigmas(problem, components(solution))
        change = max(abs(np.log(new[name] / problem.sigma[name])) for name in new)
        problem = problem.with_sigma(new)
        solution = minimise(problem, solution.state, huber=HUBER, tolerance=1e-5)
        if change < SETTLED:
            break
    return solution
