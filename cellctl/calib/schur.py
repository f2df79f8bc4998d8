"""Nonlinear least squares over a few global unknowns and one small block of unknowns a view.

Every observation depends on the globals and on one view's block only, so the normal matrix has
the shape of an arrow and the blocks are eliminated by their Schur complement: thirty views cost
thirty 6x6 inverses, not one 190x190 one. Levenberg-Marquardt with Marquardt's scaling; Huber's
loss by reweighting. Triggs et al., Bundle adjustment: a modern synthesis, 2000, sections 4 and 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from cellctl.errors import SolveError
from cellctl.geometry import Array

State = TypeVar("State")

LARGEST_DAMPING = 1e8
NEGLIGIBLE = 1e-12
"""A cost, in squared standard deviations."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """Observations of n views at a state, in units of their standard deviation.

    `residuals` (n, k, d), zero where nothing was seen; their derivatives `by_globals`
    (n, k, d, g) and `by_locals` (n, k, d, l). A residual of d numbers is weighted as one.

    A part of a larger problem has derivatives by its own `columns` of the globals only, and by
    the blocks of its own `views`, as many as n; or by none, and is one "view" (n = 1, l = 0).
    """

    residuals: Array
    by_globals: Array
    by_locals: Array
    columns: Array | slice = field(default_factory=lambda: slice(None))
    views: slice = field(default_factory=lambda: slice(None))

    def weighted(self, huber: float) -> Linearised:
        """With the square roots of Huber's weights multiplied in."""
        if not np.isfinite(huber):
            return self
        lengths = np.linalg.norm(self.residuals, axis=-1)
        if lengths.max(initial=0.0) <= huber:
            return self
        scale = np.sqrt(huber / np.maximum(lengths, huber))[..., None]
        return replace(
            self,
            residuals=self.residuals * scale,
            by_globals=self.by_globals * scale[..., None],
            by_locals=self.by_locals * scale[..., None],
        )

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """Residuals (n, k d, 1) and derivatives (n, k d, g), (n, k d, l), view by view."""
        n, k, d = self.residuals.shape
        return (
            self.residuals.reshape(n, k * d, 1),
            self.by_globals.reshape(n, k * d, self.by_globals.shape[-1]),
            self.by_locals.reshape(n, k * d, self.by_locals.shape[-1]),
        )


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

    def linearise(self, state: State) -> Linearised | Sequence[Linearised]: ...

    def residuals(self, state: State) -> Array | Sequence[Array]:
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
    def normal(self) -> Normal:
        """The normal equations at the end."""
        return _normal(self.problem, self.state, self.huber)

    @cached_property
    def _covariances(self) -> tuple[Array, Array]:
        return _covariance(self.normal)


@dataclass(frozen=True, eq=False)
class Normal:
    """The normal equations: A (g, g), B (n, g, l), C (n, l, l); gradients a (g,), b (n, l)."""

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
    found = problem.residuals(state)
    parts = [found] if isinstance(found, np.ndarray) else found
    priors = problem.priors(state)
    total = float(np.square(priors.on_globals).sum() + np.square(priors.on_locals).sum())
    for part in parts:
        squares = np.square(part).sum(axis=-1)
        if np.isfinite(huber) and squares.max(initial=0.0) > huber**2:
            far = 2.0 * huber * np.sqrt(squares) - huber**2
            squares = np.where(squares <= huber**2, squares, far)
        total += float(squares.sum())
    return 0.5 * total if np.isfinite(total) else np.inf


def _normal(problem: Problem[State], state: State, huber: float) -> Normal:
    seen, priors = problem.linearise(state), problem.priors(state)
    Pg, Pl = priors.globals_jacobian, priors.locals_jacobian
    Plt = np.swapaxes(Pl, 1, 2)
    normal = Normal(
        A=Pg.T @ Pg,
        B=np.zeros((len(Pl), Pg.shape[1], Pl.shape[2])),
        C=Plt @ Pl,
        a=Pg.T @ priors.on_globals,
        b=(Plt @ priors.on_locals[..., None])[..., 0],
    )
    for part in (seen,) if isinstance(seen, Linearised) else seen:
        _add(normal, part.weighted(huber))
    return normal


def _add(normal: Normal, part: Linearised) -> None:
    r, G, L = part.rows
    columns, views = part.columns, part.views
    tall = G.reshape(G.shape[0] * G.shape[1], G.shape[2])  # one product of matrices, not one a view
    square = (columns, columns) if isinstance(columns, slice) else np.ix_(columns, columns)
    normal.A[square] += tall.T @ tall
    normal.a[columns] += tall.T @ r.reshape(-1)
    if L.shape[-1]:
        Lt = np.swapaxes(L, 1, 2)
        normal.B[views, columns] += np.swapaxes(G, 1, 2) @ L
        normal.C[views] += Lt @ L
        normal.b[views] += (Lt @ r)[..., 0]


def _step(normal: Normal, damping: float) -> tuple[Array, Array]:
    """The damped Gauss-Newton step (g,), (n, l)."""
    A = normal.A + np.diag(damping * normal.A.diagonal())
    C = normal.C.copy()
    diagonal = np.arange(C.shape[-1])
    C[:, diagonal, diagonal] *= 1.0 + damping
    inverse_C, Bt = inverse_of(C), np.swapaxes(normal.B, 1, 2)
    reduce = normal.B @ inverse_C
    S = A - _summed(reduce, normal.B)
    by_globals = _solved(S, (reduce @ normal.b[..., None]).sum(axis=0)[:, 0] - normal.a)
    by_locals = -(inverse_C @ (normal.b + Bt @ by_globals)[..., None])[..., 0]
    return by_globals, by_locals


def _covariance(normal: Normal) -> tuple[Array, Array]:
    inverse_C = inverse_of(normal.C)
    reduce = normal.B @ inverse_C
    S = normal.A - _summed(reduce, normal.B)
    globals_covariance = inverse_of(S)
    locals_covariance = inverse_C + np.swapaxes(reduce, 1, 2) @ globals_covariance @ reduce
    return globals_covariance, locals_covariance


def _summed(one: Array, other: Array) -> Array:
    """sum_i one_i other_i^T (g, g) of (n, g, l), as one product of matrices."""
    n, g, size = one.shape
    flat = [np.moveaxis(part, 1, 0).reshape(g, n * size) for part in (one, other)]
    return np.asarray(flat[0] @ flat[1].T)


def _solved(S: Array, right: Array) -> Array:
    """S^-1 right (g,), whether or not everything is observed."""
    size = np.sqrt(np.maximum(S.diagonal(), 1e-300))
    try:
        factor = cho_factor(S / np.outer(size, size), check_finite=False)
    except LinAlgError:
        return np.asarray(inverse_of(S) @ right)
    return np.asarray(cho_solve(factor, right / size, check_finite=False) / size)


def inverse_of(matrices: Array) -> Array:
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
