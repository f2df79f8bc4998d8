"""The joint adjustment of camera pose and table to drawn circles, as a family of corrections.

Another pose of the camera, or another plane of the table, changes where a point of the table is
pictured by a homography. So adjusting both, held by what hand-eye and touch already know, is the
projective correction with a prior: its parameters are the pose's and the plane's in standard
deviations, and what they do to the homography is linear at their size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.refine_fit import Family, Frame, Marks
from cellctl.geometry import Array, Transform, pose_matrix

TABLE_HEIGHT_M, TABLE_TILT_RAD = 5e-4, 2e-3
"""Standard deviations of a table that was touched."""
LEAST = 6


def joint_family(base: Calibration, pose_covariance: Array, marks: Marks, frame: Frame) -> Family:
    """From the covariance (6, 6) of small turns (rad) and shifts (m) of T_world_camera in the
    camera's own frame, as HandEyeResult has it."""
    values, vectors = np.linalg.eigh(pose_covariance)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))
    sigmas = np.zeros((9, 9))
    sigmas[:6, :6] = roots
    sigmas[6:, 6:] = np.diag([TABLE_HEIGHT_M, TABLE_TILT_RAD, TABLE_TILT_RAD])
    pivot = np.append(marks.xy.mean(axis=0), 0.0)
    columns = [
        (_homography(base, frame, pivot, one) - _homography(base, frame, pivot, -one)) / 2
        for one in sigmas.T
    ]
    entries = np.stack([column.reshape(9)[:8] for column in columns], axis=1)
    return Family("joint", LEAST, entries, known=True)


def _homography(base: Calibration, frame: Frame, pivot: Array, move: Array) -> Array:
    """(3, 3) in scaled coordinates: from where `base` pictures a point of the table to where it
    is pictured when pose and plane are moved by (9,), the plane's height and tilts at `pivot`."""
    pose = base.T_world_camera
    moved = replace(
        base,
        T_world_camera=Transform(
            pose.parent, pose.child, pose.matrix @ pose_matrix(move[:3], move[3:6])
        ),
        table=_tilted(base.table, pivot, move[6:]),
    )
    scaled = np.diag([1.0, 1.0, frame.scale])
    scaled[:2, 2] = -frame.centre
    scaled[2, 2] = frame.scale
    H = scaled @ moved.table_homography @ np.linalg.inv(base.table_homography)
    H = H @ np.linalg.inv(scaled)
    return H / H[2, 2]


def _tilted(table: Plane, pivot: Array, move: Array) -> Plane:
    """Raised by move[0] metres at `pivot`'s x and y, and tilted there by the slopes move[1:]."""
    slope = -table.normal[:2] / table.normal[2]
    height = table.point[2] + slope @ (pivot[:2] - table.point[:2]) + move[0]
    normal = np.append(-(slope + move[1:]), 1.0)
    return Plane(np.append(pivot[:2], height), normal / np.linalg.norm(normal))
