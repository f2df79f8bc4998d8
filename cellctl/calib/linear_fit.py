"""Linear least squares in blocks, what each block says when it is left out, and which one is a
gross error. Exact, without solving again: R. Cook and S. Weisberg, Residuals and influence in
regression, 1982, chapter 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri

from cellctl.errors import SolveError
from cellctl.geometry import Array

SINGULAR = 1e-9
PROBABILITY = 0.01
"""That the worst of good blocks is taken for a gross error, in all."""


@dataclass(frozen=True, eq=False)
class Noise:
    """What is thought of a residual beforehand: its standard deviation, and how many residuals'
    worth that opinion has."""

    sigma: float
    weight: float


@dataclass(frozen=True, eq=False)
class LinearFit:
    """The least squares solution `x` (p,) of `design` (n, b, p) x = `right` (n, b).

    `residuals` (n, b) are right - design x; `held_out` (n, b) those of each block when it is not
    used, infinite when the rest does not determine x. SolveError when the blocks do not.
    """

    x: Array
    residuals: Array
    held_out: Array
    inverse: Array
    condition: float

    @classmethod
    def of(cls, design: Array, right: Array) -> LinearFit:
        n, b, p = design.shape
        stacked = design.reshape(n * b, p)
        size = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
        values = np.linalg.svd(stacked / size, compute_uv=False)
        if n * b < p or values[-1] < SINGULAR * values[0]:
            raise SolveError(f"{n} observations do not determine {p} unknowns")
        inverse = np.linalg.inv((stacked / size).T @ (stacked / size)) / np.outer(size, size)
        x = inverse @ (stacked.T @ right.reshape(-1))
        residuals = right - design @ x
        left = np.eye(b) - design @ inverse @ np.swapaxes(design, 1, 2)
        held_out = np.full((n, b), np.inf)
        known = np.linalg.eigvalsh(left)[:, 0] > 1e-7
        held_out[known] = np.linalg.solve(left[known], residuals[known][..., None])[..., 0]
        return cls(x, residuals, held_out, inverse, float(values[0] / values[-1]))

    @property
    def spare(self) -> int:
        """Residuals beyond what the unknowns need."""
        return self.residuals.size - len(self.x)

    @property
    def sum_of_squares(self) -> float:
        return float(np.square(self.residuals).sum())

    def variance(self, noise: Noise | None = None) -> float:
        """Of a residual, from the data and, if given, from an opinion; nan without either."""
        weight = noise.weight if noise else 0.0
        total = self.sum_of_squares + (noise.weight * noise.sigma**2 if noise else 0.0)
        return total / (self.spare + weight) if self.spare + weight > 0 else float("nan")

    def worst(self, noise: Noise) -> int | None:
        """The block that is a gross error: so far off that, of as many good blocks, the worst is
        as far off once in 1 / PROBABILITY times. An F test of each block's deletion, Bonferroni's
        correction."""
        n, b = self.residuals.shape
        held_out = np.where(np.isfinite(self.held_out), self.held_out, 0.0)
        drop = (self.residuals * held_out).sum(axis=1)
        worst = int(np.argmax(drop))
        spare = self.spare - b + noise.weight
        if spare <= 0 or drop[worst] <= 0:
            return None
        rest = max(self.sum_of_squares - float(drop[worst]), 0.0)
        variance = (rest + noise.weight * noise.sigma**2) / spare
        limit = fdtri(b, spare, 1.0 - PROBABILITY / n)
        return worst if drop[worst] / b > limit * variance else None


def without_gross_errors(
    design: Array, right: Array, noise: Noise, *, least: int, most: int
) -> tuple[LinearFit, Array]:
    """The fit to all blocks but gross errors, and the numbers of the blocks that are used: at
    least `least`, all but `most` at most. Blocks without which nothing is determined are used."""
    used = np.arange(len(design))
    fit = LinearFit.of(design, right)
    for _ in range(most):
        worst = fit.worst(noise)
        if worst is None or len(used) <= least:
            break
        rest = np.delete(used, worst)
        try:
            fit = LinearFit.of(design[rest], right[rest])
        except SolveError:
            break
        used = rest
    return fit, used
