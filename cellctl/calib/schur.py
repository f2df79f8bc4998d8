"""Nonlinear least squares over a few global unknowns and one small block of unknowns a view.

Every observation depends on the globals and on one view's block only, so the normal matrix has
the shape of an arrow and the blocks are eliminated by their Schur complement: thirty views cost
thirty 6x6 inverses, not one 190x190 one. Levenberg-Marquardt with Marquardt's scaling; Huber's
loss by reweighting. Triggs et al., Bundle adjustment: a modern synthesis, 2000, sections 4 and 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from cellctl.errors import SolveError
from cellctl.geometry import Array

State = TypeVar("State")

LARGEST_DAMPING = 1e8
NEGLIGIBLE = 1e-12
"""A cost, in squared standard deviations."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """Observations of n views at a state, in units of their standard deviation.

    `residuals` (n, k, 2), zero where nothing was seen; their derivatives `by_globals`
    (n, k, 2, g) and `by_locals` (n, k, 2, l).
    """

    residuals: Array
    by_globals: Array
    by_locals: Array


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known beside the observations, whitened: residuals (g',) with their derivatives
    (g', g) by the globals, and (n, l') with (n, l', l) by the locals of each view."""

    on_globals: Array
    globals_jacobian: Array
    on_locals: Array
    locals_jacobian: Array


class Problem(Protocol[State]):
    """What `minimise` needs to know. A state is never changed, `retract` makes the next one."""

    def linearise(self, state: State) -> Linearised: ...

    def residuals(self, state: State) -> Array:
        """As in `Linearised`; not-a-number where the state cannot explain an observation."""
        ...

    def priors(self, state: State) -> Priors: ...

    def retract(self, state: State, by_globals: Array, by_locals: Array) -> State:
        """The state moved by (g,) and (n, l)."""
        ...


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """Where `minimise` ended. `cost` is half the sum of squares (of Huber's loss)."""

    problem: Problem[State]
    state: State
    huber: float
    cost: float
    iterations: int
    converged: bool

    @property
    def globals_covariance(self) -> Array:
        """(g, g), for observations of unit standard deviation."""
        return self._covariances[0]

    @property
    def locals_covariance(self) -> Array:
        """(n, l, l), with what the uncertainty of the globals adds."""
        return self._covariances[1]

    @cached_property
    def _covariances(self) -> tuple[Array, Array]:
        return _covariance(_normal(self.problem, self.state, self.huber))


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: A (g, g), B (n, g, l), C (n, l, l); gradients a (g,), b (n, l)."""

    A: Array
    B: Array
    C: Array
    a: Array
    b: Array


def minimise(
    problem: Problem[State],
    state: State,
    *,
    huber: float = np.inf,
    max_iterations: int = 100,
    tolerance: float = 1e-12,
) -> Solution[State]:
    """Minimise from `state`; `huber` is the length of a residual, in standard deviations, from
    which its weight falls. Converged when an accepted step lowers the cost by less than
    `tolerance` of it. SolveError when the start explains nothing."""
    cost = _cost(problem, state, huber)
    if not np.isfinite(cost):
        raise SolveError("the start of the adjustment lies behind the camera")
    damping, converged = 1e-4, False
    normal = _normal(problem, state, huber)
    iteration = 0
    while iteration < max_iterations and not converged:
        iteration += 1
        candidate = problem.retract(state, *_step(normal, damping))
        new_cost = _cost(problem, candidate, huber)
        better = new_cost <= cost
        if better:
            converged = cost - new_cost <= tolerance * cost + NEGLIGIBLE
            state, cost, damping = candidate, new_cost, max(damping / 10.0, 1e-12)
        else:
            damping *= 10.0
            converged = damping > LARGEST_DAMPING
        if better and not converged:
            normal = _normal(problem, state, huber)
    return Solution(problem, state, huber, cost, iteration, converged)


def _cost(problem: Problem[State], state: State, huber: float) -> float:
    squares = np.square(problem.residuals(state)).sum(axis=-1)
    if not np.isfinite(squares).all():
        return np.inf
    priors = problem.priors(state)
    loss = squares
    if np.isfinite(huber):
        loss = np.where(squares <= huber**2, squares, 2.0 * huber * np.sqrt(squares) - huber**2)
    prior_loss = np.square(priors.on_globals).sum() + np.square(priors.on_locals).sum()
    return 0.5 * float(loss.sum() + prior_loss)


def _normal(problem: Problem[State], state: State, huber: float) -> _Normal:
    seen, priors = problem.linearise(state), problem.priors(state)
    lengths = np.linalg.norm(seen.residuals, axis=-1)
    weights = np.sqrt(huber / np.maximum(lengths, huber)) if np.isfinite(huber) else 1.0
    scale = np.broadcast_to(weights, lengths.shape)[..., None]
    n = len(lengths)
    r = (seen.residuals * scale).reshape(n, -1, 1)
    G = (seen.by_globals * scale[..., None]).reshape(n, r.shape[1], -1)
    L = (seen.by_locals * scale[..., None]).reshape(n, r.shape[1], -1)
    Gt, Lt = np.swapaxes(G, 1, 2), np.swapaxes(L, 1, 2)
    Pg, Pl = priors.globals_jacobian, priors.locals_jacobian
    Plt = np.swapaxes(Pl, 1, 2)
    return _Normal(
        A=(Gt @ G).sum(axis=0) + Pg.T @ Pg,
        B=Gt @ L,
        C=Lt @ L + Plt @ Pl,
        a=(Gt @ r).sum(axis=0)[:, 0] + Pg.T @ priors.on_globals,
        b=(Lt @ r + Plt @ priors.on_locals[..., None])[..., 0],
    )


def _step(normal: _Normal, damping: float) -> tuple[Array, Array]:
    """The damped Gauss-Newton step (g,), (n, l)."""
    A = normal.A + np.diag(damping * normal.A.diagonal())
    C = normal.C.copy()
    diagonal = np.arange(C.shape[-1])
    C[:, diagonal, diagonal] *= 1.0 + damping
    inverse_C, Bt = _inverse(C), np.swapaxes(normal.B, 1, 2)
    reduce = normal.B @ inverse_C
    S = A - (reduce @ Bt).sum(axis=0)
    by_globals = _inverse(S) @ ((reduce @ normal.b[..., None]).sum(axis=0)[:, 0] - normal.a)
    by_locals = -(inverse_C @ (normal.b + Bt @ by_globals)[..., None])[..., 0]
    return by_globals, by_locals


def _covariance(normal: _Normal) -> tuple[Array, Array]:
    inverse_C = _inverse(normal.C)
    reduce = normal.B @ inverse_C
    S = normal.A - (reduce @ np.swapaxes(normal.B, 1, 2)).sum(axis=0)
    globals_covariance = _inverse(S)
    locals_covariance = inverse_C + np.swapaxes(reduce, 1, 2) @ globals_covariance @ reduce
    return globals_covariance, locals_covariance


def _inverse(matrices: Array) -> Array:
    """Inverse of symmetric positive matrices (..., m, m), scaled to a unit diagonal first since
    pixels, radians and metres differ by orders of magnitude. A direction that nothing observes
    gets a huge variance instead of an exception."""
    m = matrices.shape[-1]
    if m == 0:
        return matrices
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    diagonal = np.sqrt(np.maximum(diagonal, 1e-30 * max(float(diagonal.max()), 1e-30)))
    outer = diagonal[..., :, None] * diagonal[..., None, :]
    values, vectors = np.linalg.eigh(matrices / outer)
    values = np.maximum(values, 1e-15)
    return (vectors / values[..., None, :]) @ np.swapaxes(vectors, -1, -2) / outer
