"""Light against ink: where a calibration puts light for a point, and where the pen stands there.

Both are compared where the camera sees them. `judge_by` is the calibration that knows best how the
camera sees table and projector; the one that is compared may be any, such as an earlier stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.projector_map import apply_homography
from cellctl.calib.refine_fit import Mark
from cellctl.calib.views import rms
from cellctl.geometry import Array


@dataclass(frozen=True, eq=False)
class Gaps:
    """From ink to light: `px` (n, 2) in projector pixels, `mm` (n, 2) along world x and y."""

    px: Array
    mm: Array

    @property
    def rms_px(self) -> float:
        """Root mean square of the 2-D distance: the paper's e_RMSE, Eq. (9)."""
        return rms(self.px)

    @property
    def rms_mm(self) -> float:
        """As `rms_px`."""
        return rms(self.mm)


def gaps(
    compared: Calibration, marks: Sequence[Mark], judge_by: Calibration, tcp_mm: Array
) -> Gaps:
    """Between marks and the light that `compared` would send for their commanded points.

    `tcp_mm` (2,) is by how much the pen stands off (`RefineResult.tcp_mm`): what that does at the
    yaw at which a circle was drawn is no error of a calibration, which is meant for yaw 0.
    """
    ink = upright(marks, judge_by, tcp_mm)
    pixels = compared.project(np.array([mark.xy for mark in marks]))
    light = placed(judge_by, judge_by.projector.locate(pixels))
    return Gaps(px=pixels - judge_by.project(ink), mm=1e3 * (light - ink))


def gaps_seen(lit: Array, marks: Sequence[Mark], judge_by: Calibration, tcp_mm: Array) -> Gaps:
    """Between marks and light that was sent for them and seen at `lit` (n, 2), undistorted
    normalised camera coordinates."""
    ink = upright(marks, judge_by, tcp_mm)
    light = placed(judge_by, lit)
    return Gaps(px=judge_by.projector.project(lit) - judge_by.project(ink), mm=1e3 * (light - ink))


def upright(marks: Sequence[Mark], judge_by: Calibration, tcp_mm: Array) -> Array:
    """World (n, 2), metres, where the marks would be had the tool not been turned."""
    yaw = np.array([mark.yaw for mark in marks])
    x, y = 1e-3 * np.asarray(tcp_mm)
    turned = np.column_stack(
        [np.cos(yaw) * x - np.sin(yaw) * y - x, np.sin(yaw) * x + np.cos(yaw) * y - y]
    )
    return placed(judge_by, np.array([mark.seen for mark in marks])) - turned


def placed(calibration: Calibration, xy: Array) -> Array:
    """World (n, 2), metres, of what the camera sees on the table at undistorted normalised
    coordinates (n, 2)."""
    if calibration.refinement is not None:
        xy = calibration.refinement.undo(xy)
    return apply_homography(np.linalg.inv(calibration.table_homography), xy)
