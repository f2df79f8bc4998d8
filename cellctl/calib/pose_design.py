"""Which views of a board on the flange tell most about where the camera sees the table.

x_camera = T_world_camera^-1 T_world_flange S T_flange_board b, S being what the arm is off by, b a
point of the board whose print is larger than stated by a share. Small turns and shifts xi = (w, v)
of T_world_camera and T_flange_board act in their child frames. Unknown are both and the share; a
view tells of them what is left when S, of ROBOT_SIGMA, and the corners' noise are taken out.
"""

from __future__ import annotations

import numpy as np

from cellctl.calib.design import Design
from cellctl.geometry import Array, invert

CORNER_SIGMA_PX = 0.15
ROBOT_SIGMA = np.array([8e-4, 8e-4, 8e-4, 5e-4, 5e-4, 5e-4])
"""rad and metres: what repeats, and what the reported kinematics are off by from pose to pose."""
TAPE = (np.radians(10.0), 0.1)
PRINT_SIGMA = 0.005


def view_rows(
    points: Array,
    T_camera_board: Array,
    T_flange_board: Array,
    focal_px: float,
    robot_sigma: Array = ROBOT_SIGMA,
) -> Array:
    """Rows (m, 2k, 13) of views of board points (k, 3), metres, at T_camera_board (m, 4, 4) with
    T_flange_board (4, 4): by both poses and the print's scale, in standard deviations."""
    turned = np.einsum("mij,kj->mki", T_camera_board[:, :3, :3], points)
    seen = turned + T_camera_board[:, None, :3, 3]
    pictured = focal_px * _projection(seen)
    by_twist = pictured @ _by_twist(seen)
    board, flange = (
        _adjoint(pose) for pose in (T_camera_board, T_camera_board @ invert(T_flange_board))
    )
    by_scale = pictured @ turned[..., None]
    rows = np.concatenate([-by_twist, by_twist @ board[:, None], by_scale], axis=-1)
    slips = by_twist @ flange[:, None] * robot_sigma
    m = len(T_camera_board)
    rows, slips = rows.reshape(m, -1, 13), slips.reshape(m, -1, 6)
    noise = CORNER_SIGMA_PX**2 * np.eye(rows.shape[1]) + slips @ np.swapaxes(slips, 1, 2)
    return np.linalg.solve(np.linalg.cholesky(noise), rows)


def view_design(places: Array, T_world_camera: Array) -> Design:
    """Before any view: the error in mm of where the camera sees world places (g, 3) is wanted, on
    the table, which it looks upon about squarely."""
    seen = places @ T_world_camera[:3, :3] - T_world_camera[:3, 3] @ T_world_camera[:3, :3]
    on_table = 1e3 * seen[:, 2, None, None] * _projection(seen)
    interest = np.zeros((len(places), 2, 13))
    interest[..., :6] = -on_table @ _by_twist(seen)
    sigmas = np.concatenate([np.repeat(TAPE, 3), np.repeat(TAPE, 3), [PRINT_SIGMA]])
    return Design(np.diag(sigmas**-2.0), interest)


def _projection(p: Array) -> Array:
    """Derivatives (..., 2, 3) of p_xy / p_z by p (..., 3)."""
    out = np.zeros((*p.shape[:-1], 2, 3))
    out[..., 0, 0] = out[..., 1, 1] = 1.0 / p[..., 2]
    out[..., 2] = -p[..., :2] / p[..., 2:] ** 2
    return out


def _by_twist(p: Array) -> Array:
    """Derivatives (..., 3, 6) of w x p + v by (w, v)."""
    return np.concatenate([-_cross(p), np.broadcast_to(np.eye(3), (*p.shape, 3))], axis=-1)


def _cross(p: Array) -> Array:
    """Matrices (..., 3, 3) with _cross(p) q = p x q."""
    x, y, z = np.moveaxis(p, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*p.shape, 3)


def _adjoint(poses: Array) -> Array:
    """(m, 6, 6): T exp(xi) = exp(Ad xi) T."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    out = np.zeros((len(poses), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, 3:, :3] = _cross(t) @ R
    return out
