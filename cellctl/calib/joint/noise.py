"""What each group of observations says about the globals, and how noisy it is.

Every row of observations or priors a = (G, L), by globals and by the locals of its view, acts on
the globals through its reduced row G - L C^-1 B^T. The reduced rows of all groups add up to the
Schur complement S = sum_g N_g, N_g = A_g^T A_g; so the estimator is a sum over the groups' noises
and its covariance splits exactly: S^-1 = sum_g S^-1 N_g S^-1.

Variance components after W. Foerstner, Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten, 1979: a group's squares over its redundancy, the number of its rows less the
trace of its part of the hat matrix.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.state import JointState
from cellctl.calib.schur import Linearised, Normal, Solution, inverse_of
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Opinion:
    """What is thought of a noise beforehand, and how many rows' worth that is."""

    sigma: float
    weight: float


OPINIONS = {
    "turn": Opinion(float(np.radians(0.05)), 6.0),
    "shift": Opinion(0.5e-3, 6.0),
    "touch": Opinion(0.1e-3, 4.0),
    "markers": Opinion(0.05, 1.0),
    "lit": Opinion(0.1, 1.0),
    "draw": Opinion(0.2, 8.0),
    "field": Opinion(0.2, 4.0),
    "bend": Opinion(0.05, 4.0),
}
VIEWS = Opinion(0.1, 1.0)
LEAST = 1e-3
"""Of its opinion: no noise is thought to be less, so that perfect data remain solvable."""


@dataclass(frozen=True, eq=False)
class Information:
    """Of one group, in units of its noise: the `reduced` information (u, g, g) on the globals of
    each of its units (views, circles, ...); `squares` and number of its `rows`; and `explained`,
    the trace of its part of the hat matrix."""

    reduced: Array
    squares: float
    rows: int
    explained: float

    @property
    def total(self) -> Array:
        """(g, g)."""
        return self.reduced.sum(axis=0)

    @property
    def redundancy(self) -> float:
        return max(self.rows - self.explained, 0.0)


def information(solution: Solution[JointState]) -> dict[str, Information]:
    """By group: those of JointProblem.sigma, and "prior" for what is fixed beforehand."""
    problem, state = solution.problem, solution.state
    assert isinstance(problem, JointProblem)
    back = _Back.of(solution.normal, solution.globals_covariance)
    found: dict[str, Information] = {}
    for name, part in problem.parts(state).items():
        group = "lit" if name.startswith("lit ") else name
        one = back.information(part.weighted(solution.huber))
        found[group] = _merged(found[group], one) if group in found else one
    return found | _of_priors(problem, state, back)


def sigmas(problem: JointProblem, found: Mapping[str, Information]) -> dict[str, float]:
    """The noises that the residuals ask for, given those that were assumed."""
    new = {}
    for name, sigma in problem.sigma.items():
        opinion = OPINIONS.get(name, VIEWS)
        if name not in found:
            new[name] = sigma
            continue
        group = found[name]
        squares = group.squares * sigma**2 + opinion.weight * opinion.sigma**2
        new[name] = max(
            float(np.sqrt(squares / (group.redundancy + opinion.weight))), LEAST * opinion.sigma
        )
    return new


@dataclass(frozen=True, eq=False)
class _Back:
    """What reduces rows: C^-1 (n, l, l) and B C^-1 (n, g, l), and the globals' covariance."""

    inverse_C: Array
    reduce: Array
    covariance: Array

    @classmethod
    def of(cls, normal: Normal, covariance: Array) -> _Back:
        inverse_C = inverse_of(normal.C)
        return cls(inverse_C, normal.B @ inverse_C, covariance)

    def information(self, part: Linearised) -> Information:
        r, G, L = part.rows
        count = len(self.covariance)
        wide = np.zeros((len(r), r.shape[1], count))
        wide[..., part.columns] = G
        local = 0.0
        if L.shape[-1]:
            wide -= L @ np.swapaxes(self.reduce[part.views], 1, 2)
            local = float(np.einsum("nki,nij,nkj->", L, self.inverse_C[part.views], L))
        else:  # each residual is a unit of its own
            wide = wide.reshape(-1, part.residuals.shape[-1], count)
        return self._of_rows(wide, np.square(r), local)

    def of_local_prior(self, slopes: Array, off: Array, rows: slice) -> Information:
        """Of `rows` of whitened residuals (n, 6) with derivatives (n, 6, 6) by the locals; zero
        for views of which nothing is known."""
        part, squares = slopes[:, rows], np.square(off[:, rows])
        wide = -part @ np.swapaxes(self.reduce, 1, 2)
        local = float(np.einsum("nki,nij,nkj->", part, self.inverse_C, part))
        found = self._of_rows(wide, squares, local)
        return replace(found, rows=3 * int(part.any(axis=(1, 2)).sum()))

    def of_global_prior(self, off: Array, jacobian: Array) -> Information:
        return self._of_rows(jacobian[None], np.square(off), 0.0)

    def _of_rows(self, wide: Array, squares: Array, local: float) -> Information:
        reduced = np.swapaxes(wide, 1, 2) @ wide
        explained = float((reduced.sum(axis=0) * self.covariance).sum()) + local
        return Information(reduced, float(squares.sum()), squares.size, explained)


def _merged(one: Information, other: Information) -> Information:
    return Information(
        np.concatenate([one.reduced, other.reduced]),
        one.squares + other.squares,
        one.rows + other.rows,
        one.explained + other.explained,
    )


def _of_priors(problem: JointProblem, state: JointState, back: _Back) -> dict[str, Information]:
    found, count = {}, problem.layout.count
    priors = problem.priors(state)
    if priors.on_locals.size:
        turn, shift = (
            back.of_local_prior(priors.locals_jacobian, priors.on_locals, rows)
            for rows in (slice(0, 3), slice(3, 6))
        )
        found["turn"], found["shift"] = turn, shift
    rest = [(np.zeros(0), np.zeros((0, count)))]
    for name, (off, slopes) in problem.global_priors(state).items():
        jacobian = np.zeros((len(off), count))
        jacobian[:, problem.layout.slices[name]] = slopes
        if name in ("field", "bend", "robot", "look", "level"):
            found[name] = back.of_global_prior(off, jacobian)
        else:
            rest.append((off, jacobian))
    off, jacobian = (np.concatenate(parts) for parts in zip(*rest, strict=True))
    found["prior"] = back.of_global_prior(off, jacobian)
    return found
