"""A controller that cuts corners: circles come out smaller, as blending or a lagging servo do."""

from __future__ import annotations

import numpy as np

from cellctl import ik
from cellctl.geometry import Array
from cellctl.sim.truth import Truth

LOWEST_M = 3e-3
"""What of a stroke is its figure: the tip is within this of its lowest point."""
FADE_M = 3e-3
"""Over this way a stroke leaves its commanded start, and returns to its commanded end."""


def shrunk(truth: Truth, joints: Array, factor: float) -> Array:
    """Joints (n, 6) of a stroke whose figure is `factor` times as large about its middle; it
    begins and ends as commanded."""
    flanges = truth.nominal_arm.forward(joints)
    tips = flanges[:, :3, :3] @ truth.nominal_pen + flanges[:, :3, 3]
    figure = tips[tips[:, 2] < tips[:, 2].min() + LOWEST_M, :2]
    if len(figure) < 3:
        return joints
    centre, _ = fitted_circle(figure)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(tips, axis=0), axis=1))])
    share = np.clip(np.minimum(way, way[-1] - way) / FADE_M, 0.0, 1.0)[:, None]
    flanges[:, :2, 3] += share * (factor - 1.0) * (tips[:, :2] - centre)
    found, _ = ik.refine(truth.nominal_arm, flanges, joints)
    return found


def fitted_circle(points: Array) -> tuple[Array, float]:
    """Centre (2,) and radius of the circle nearest to points (n, 2), n > 2, in the algebraic
    sense (I. Kasa, IEEE Trans. Instrum. Meas. 25, 1976)."""
    middle = points.mean(axis=0)
    xy = points - middle
    (a, b, c), *_ = np.linalg.lstsq(
        np.column_stack([2 * xy, np.ones(len(xy))]), (xy**2).sum(axis=1), rcond=None
    )
    return middle + (a, b), float(np.sqrt(max(c + a**2 + b**2, 0.0)))
