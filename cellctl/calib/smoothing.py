"""How smooth a correction of free form is to be, from what a plain one leaves.

A thin-plate spline and a Gaussian process with a linear trend are the same ridge regression on
different radial functions: weights that are orthogonal to the trend, and a penalty w^T K w. With
the eigenvectors of K the penalty is the plain sum of squares. Wahba, Spline models for
observational data, 1990, sections 1.3 and 2.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space
from scipy.optimize import minimize

from cellctl.calib.refinement import kernel_values
from cellctl.geometry import Array

RIDGES = np.logspace(-4, 3, 15)
LENGTHS, SIGNAL, NOISE = (0.3, 3.0), (1e-3, 1e2), (1e-3, 3.0)
"""Bounds of the Gaussian process: lengths in half the drawn area's longer side, variances in
those of what the trend leaves."""
FREE = 1e3
NEGLIGIBLE = 1e-7
"""Eigenvalues below this part of the largest are dropped: they only carry rounding errors."""


@dataclass(frozen=True, eq=False)
class Smoother:
    """Radial functions about `nodes` (k, 2). A coefficient vector a (q,) stands for the weights
    `weights` (k, q) @ a, and costs `ridge` |a|^2 beside the squared errors. `theta` (3,): the
    Gaussian process's logarithms of signal, length and noise, from where a like one may begin."""

    kernel: str
    length: float
    nodes: Array
    weights: Array
    ridge: float
    theta: Array | None = None


def smoother(kernel: str, u: Array, left: Array, start: Smoother | None = None) -> Smoother:
    """For what an affine fit has left, `left` (n, 2) at u (n, 2).

    Thin plate: the ridge with the least leave-one-out error (scikit-learn's RidgeCV). Radial
    basis: length and ridge of the largest marginal likelihood of a Gaussian process. `start`, one
    for almost the same marks, spares steps.
    """
    if kernel == "thin-plate":
        phi, weights = _orthogonal(kernel, 1.0, u)
        return Smoother(kernel, 1.0, u, weights, _cross_validated(phi, u, left))
    theta = _most_likely(u, left, None if start is None else start.theta)
    signal, length, noise = np.exp(theta).tolist()
    weights = _orthogonal(kernel, length, u)[1]
    return Smoother(kernel, length, u, weights, noise / signal, theta)


def _orthogonal(kernel: str, length: float, u: Array) -> tuple[Array, Array]:
    """Radial functions (n, q) at their nodes u (n, 2) and their weights (n, q), orthogonal to
    every affine map and of unit penalty."""
    K = kernel_values(kernel, length, u, u)
    free = null_space(np.column_stack([np.ones(len(u)), u]).T)
    values, vectors = np.linalg.eigh(free.T @ K @ free)
    kept = values > NEGLIGIBLE * values[-1]
    weights = free @ (vectors[:, kept] / np.sqrt(values[kept]))
    return K @ weights, weights


def _cross_validated(phi: Array, u: Array, left: Array) -> float:
    """The ridge. The trend is fitted along, its columns too long for the ridge to shorten."""
    trend = np.column_stack([np.ones(len(u)), u])
    columns = np.column_stack([FREE * trend, phi])
    from sklearn.linear_model import RidgeCV  # noqa: PLC0415 - seconds, and rarely needed

    found = RidgeCV(RIDGES, fit_intercept=False).fit(columns, left / max(left.std(), 1e-12))
    return float(found.alpha_)


def _most_likely(u: Array, left: Array, theta: Array | None) -> Array:
    """Logarithms (3,) of the signal's variance, the length and the noise's variance.

    Optimised here, not by scikit-learn, which warns when an optimum lies on a bound: that is an
    answer too, namely that there is nothing but noise.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415 - as above
    from sklearn.gaussian_process.kernels import (  # noqa: PLC0415
        RBF,
        ConstantKernel,
        WhiteKernel,
    )

    kernel = ConstantKernel(1.0, SIGNAL) * RBF(1.0, LENGTHS) + WhiteKernel(0.5, NOISE)
    process = GaussianProcessRegressor(kernel, optimizer=None)
    process.fit(u, left / max(left.std(), 1e-12))

    def cost(theta: Array) -> tuple[float, Array]:
        value, slope = process.log_marginal_likelihood(
            theta, eval_gradient=True, clone_kernel=False
        )
        return -value, -slope

    start = kernel.theta if theta is None else theta
    options = {"ftol": 1e-4}
    return minimize(
        cost, start, jac=True, method="L-BFGS-B", bounds=kernel.bounds, options=options
    ).x
