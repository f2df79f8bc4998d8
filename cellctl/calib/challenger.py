"""The challenger: robot (x, y) to camera by the drawn circles alone, without hand-eye.

A homography leads from where the pen stands to the undistorted picture, and a smooth field of
second and third degree follows what a bowed table and an arm's own errors add to it. The field's
size is not known beforehand: it is the one under which the circles are likeliest, often none.

Written as a correction of a calibration this is the projective family with such a field on top.
That family leaves all eight entries of a homography free, so that pose and table which it starts
from do not matter: whatever they say, their product with the correction is the homography that
the circles ask for. A calibration carries the challenger like any other refinement, and its pose
and table only say in which coordinates the correction is written. Where hand-eye has failed,
`seated` makes them from the circles. Without a field the challenger is the projective family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refine_fit import MARK_SIGMA_MM, Family, Frame, Mark, Marks, design, fit
from cellctl.errors import SolveError
from cellctl.geometry import Array, Transform, invert, pose_matrix

NAME = "challenger"
LEAST, MONOMIALS = 12, 7
NO_FIELD_MM = 1e-3
FIELDS_MM = (NO_FIELD_MM, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
"""Standard deviations of a coefficient that are tried, for marks of MARK_SIGMA_MM: about how far
the field moves a circle at the edge of the drawn area, which spans -1 to 1."""
SEAT_CIRCLES = 4
RAYLEIGH = 1.1774
"""Median length of 2-D errors whose coordinates have the standard deviation 1."""
FREE = 1e-6
"""Weight that keeps a pen's offset finite which no yaw tells from a shift of the table."""


def challenger_family(marks: Marks, frame: Frame) -> Family:
    """A free homography, and a field whose size the marks make likeliest."""
    if len(marks) < LEAST:
        return _of_size(NO_FIELD_MM)
    return _of_size(FIELDS_MM[int(np.argmin(_costs(marks, frame)))])


def _of_size(field_mm: float) -> Family:
    return Family(NAME, LEAST, np.eye(8), monomials=MONOMIALS, field_mm=field_mm)


def _costs(marks: Marks, frame: Frame) -> Array:
    """-2 log of the likelihood of each of FIELDS_MM, up to a constant."""
    plain = fit(replace(_of_size(np.inf), monomials=0), marks, frame)
    A, r = design(_of_size(NO_FIELD_MM), marks, frame, plain)
    wide = np.concatenate([A[:, :8], A[:, -2:]], axis=1)
    # A coefficient of one moves a mark by the frame's scale: in units of millimetres instead.
    smooth = A[:, 8:-2] / frame.mm
    return np.array([_restricted(wide, smooth, r, size / MARK_SIGMA_MM) for size in FIELDS_MM])


def _restricted(wide: Array, smooth: Array, r: Array, ratio: float) -> float:
    """-2 log of the restricted likelihood, up to a constant, of errors r (m,) of a wide part
    (m, p), whose parameters are unknown, and a smooth part (m, q), whose coefficients are as many
    standard deviations of the noise as `ratio`. The noise itself is estimated. Patterson and
    Thompson, Biometrika 58, 1971; Harville, JASA 72, 1977, equation 4.2."""
    V = np.eye(len(r)) + ratio**2 * smooth @ smooth.T
    both = np.linalg.solve(V, np.column_stack([wide, r]))
    normal = wide.T @ both[:, :-1] + FREE * np.eye(wide.shape[1])
    left = r @ both[:, -1] - both[:, -1] @ wide @ np.linalg.solve(normal, wide.T @ both[:, -1])
    freedom = len(r) - wide.shape[1]
    logs = np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1]
    return float(freedom * np.log(max(left, 1e-30)) + logs)


def expected_error_mm(marks: Marks, places: Array) -> float:
    """What error over world places (g, 2) these marks let expect of the challenger's map, in the
    drawing posture: root mean square of the 2-D distance, in millimetres. By the covariances for
    fields of all sizes, each as likely as the marks make it, so that few circles, which do not show
    a field, do not deny it either. Not-a-number for fewer than LEAST marks."""
    if len(marks) < LEAST:
        return float("nan")
    frame = Frame.of(marks)
    costs = _costs(marks, frame)
    weights = np.exp((costs.min() - costs) / 2)
    variances = [_expected(_of_size(size), marks, frame, places) for size in FIELDS_MM]
    return float(np.sqrt(np.average(variances, weights=weights)))


def _expected(family: Family, marks: Marks, frame: Frame, places: Array) -> float:
    """Mean variance over the places, square millimetres; by the median error, which a bad circle
    does not change."""
    found = fit(family, marks, frame)
    left = float(np.median(np.linalg.norm(found.errors_mm(marks), axis=1))) / RAYLEIGH
    sigma2 = left**2 * 2 * len(marks) / max(found.freedom, 1.0)
    J = design(family, marks.upright_at(places), frame, found)[0]
    return float(sigma2 * np.einsum("ij,ji->", J, np.linalg.solve(found.normal, J.T)) / len(places))


def seated(
    marks: Sequence[Mark], camera: CameraModel, projector: ProjectorMap, table: Plane
) -> Calibration:
    """A calibration without hand-eye, from circles drawn on a table that is known at least
    roughly: the camera's pose is the one from which the marks look as they do (PnP). It is no
    measurement of where the camera hangs, only a start: refined by the challenger, it leads light
    to where one that starts from hand-eye does. SolveError for fewer than 4 circles."""
    if len(marks) < SEAT_CIRCLES:
        raise SolveError(f"{len(marks)} circles do not seat a camera; {SEAT_CIRCLES} are needed")
    xy = np.array([mark.xy for mark in marks], dtype=float)
    seen = np.array([mark.seen for mark in marks], dtype=float)
    points = np.column_stack([xy, table.height(xy)])
    found, turn, shift = cv2.solvePnP(
        points, seen, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE
    )
    pose = pose_matrix(turn.reshape(3), shift.reshape(3))
    if not found or not np.isfinite(pose).all():
        raise SolveError("the circles' places do not say from where the camera sees them")
    return Calibration(camera, Transform("world", "camera", invert(pose)), table, projector)
