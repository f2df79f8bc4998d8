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

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cellctl.calib.joint.problem import JointProblem
from cellctl.calib.joint.state import JointState
from cellctl.calib.schur import Linearised, Solution, inverse_of
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
SMOOTH = ("field", "bend", "robot", "look", "level")
"""Unknowns that stand for what no model says: their priors are groups of their own."""
LEAST = 1e-3
"""Of its opinion: no noise is thought to be less, so that perfect data remain solvable."""


@dataclass(frozen=True, eq=False)
class Component:
    """Of one group, in units of its noise: `squares` and number of its `rows`, and `explained`,
    the trace of its part of the hat matrix."""

    squares: float
    rows: int
    explained: float

    @property
    def redundancy(self) -> float:
        return max(self.rows - self.explained, 0.0)

    def __add__(self, other: Component) -> Component:
        return Component(
            self.squares + other.squares,
            self.rows + other.rows,
            self.explained + other.explained,
        )


def components(solution: Solution[JointState]) -> dict[str, Component]:
    """By group: those of JointProblem.sigma, and what is fixed beforehand."""
    back, found = _Back.of(solution), dict[str, Component]()
    for name, part in _parts(solution):
        one = back.component(part)
        found[name] = found[name] + one if name in found else one
    return found


def information(solution: Solution[JointState]) -> dict[str, Array]:
    """By group, as `components`: the reduced information (u, g, g) on the globals of each of its
    units, which are views, circles, touches, lit points; together they make S."""
    back, found = _Back.of(solution), dict[str, Array]()
    for name, part in _parts(solution):
        one = back.reduced(part)
        found[name] = np.concatenate([found[name], one]) if name in found else one
    return found


def sigmas(problem: JointProblem, found: Mapping[str, Component]) -> dict[str, float]:
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


def _parts(solution: Solution[JointState]) -> Iterator[tuple[str, Linearised]]:
    """All rows by the name of their group, weighted; priors too, as if they were seen."""
    problem, state = solution.problem, solution.state
    assert isinstance(problem, JointProblem)
    for name, part in problem.parts(state).items():
        yield "lit" if name.startswith("lit ") else name, part.weighted(solution.huber)
    local_off, local_slopes = problem.local_priors(state)
    for name, rows in (("turn", slice(0, 3)), ("shift", slice(3, 6))):
        slopes = local_slopes[:, rows, None]
        off = local_off[:, rows, None]
        none = np.zeros((*slopes.shape[:3], 0))
        yield name, Linearised(off, none, slopes, np.zeros(0, dtype=int))
    for name, (off, slopes) in problem.global_priors(state).items():
        columns, group = problem.layout.columns([name]), name if name in SMOOTH else "prior"
        none = np.zeros((1, len(off), 1, 0))
        yield group, Linearised(off[None, :, None], slopes[None, :, None], none, columns)


@dataclass(frozen=True, eq=False)
class _Back:
    """What reduces rows: C^-1 (n, l, l), B C^-1 (n, g, l), and the covariance of the globals, of
    the globals with the locals (n, g, l), and of the locals (n, l, l)."""

    inverse_C: Array
    reduce: Array
    covariance: Array

    @classmethod
    def of(cls, solution: Solution[JointState]) -> _Back:
        inverse_C = inverse_of(solution.normal.C)
        return cls(inverse_C, solution.normal.B @ inverse_C, solution.globals_covariance)

    def component(self, part: Linearised) -> Component:
        """Without reducing a row: the trace of A^T A times the covariance of all unknowns that
        the rows A touch."""
        r, G, L = part.rows
        columns = part.columns
        mine = self.covariance[columns][:, columns]
        explained = float(((np.swapaxes(G, 1, 2) @ G).sum(axis=0) * mine).sum())
        if L.shape[-1]:
            reduce, Lt = self.reduce[part.views], np.swapaxes(L, 1, 2)
            across = self.covariance[columns] @ reduce
            explained -= 2.0 * float(((np.swapaxes(G, 1, 2) @ L) * across).sum())
            own = self.inverse_C[part.views] + np.swapaxes(reduce, 1, 2) @ self.covariance @ reduce
            explained += float(((Lt @ L) * own).sum())
        known = int(np.count_nonzero(G.any(axis=2) | L.any(axis=2)))
        return Component(float(np.square(r).sum()), known, explained)

    def reduced(self, part: Linearised) -> Array:
        _, G, L = part.rows
        wide = np.zeros((*G.shape[:2], len(self.covariance)))
        wide[..., part.columns] = G
        if L.shape[-1]:
            wide -= L @ np.swapaxes(self.reduce[part.views], 1, 2)
        else:  # each residual is a unit of its own
            wide = wide.reshape(-1, part.residuals.shape[-1], wide.shape[-1])
        return np.swapaxes(wide, 1, 2) @ wide
