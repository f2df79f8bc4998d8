"""Where pen and light stand in the camera's undistorted picture, and the derivatives by every
unknown.

All three compare in the camera's plane: the pen at (x, y) is pictured at `pen`, the projector
pixel p at `light_on_table` or `light_on_board`. For an intersection X = o + s d of a ray with a
surface F = 0 of normal n: dX = P (do + s dd) - d dF / (n . d), P = 1 - d n^T / (n . d).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.calib.camera import coefficient_slopes, distort_slopes
from cellctl.calib.chain import Chain
from cellctl.calib.joint.state import BoardState, Field, FullProjector, JointState
from cellctl.calib.pose import derivatives_by_pose
from cellctl.calib.projector_map import ProjectorMap, homography_jacobian
from cellctl.calib.refinement import homography_slopes
from cellctl.geometry import Array, invert, transform_points


@dataclass(frozen=True, eq=False)
class Picture:
    """Undistorted normalised camera coordinates `xy` (n, 2); their derivatives (n, 2, c) by the
    unknowns of each name, and by the correction of the one view concerned, (n, 2, 6) if any."""

    xy: Array
    slopes: dict[str, Array]
    by_correction: Array | None = None


def world_camera(state: JointState, look: Array) -> Array:
    """T_world_camera (4, 4) as the table was pictured, T_world_anchor being `look`."""
    return look @ state.look_off @ state.camera_pose


def pen(state: JointState, look: Array, field: Field | None, xy: Array, turn: Array) -> Picture:
    """Of the pen, commanded to xy (n, 2) m with its tool turned by `turn` (n, 2, 2), R(yaw).
    "place" stands for xy itself."""
    place = xy + turn @ state.tcp
    T = world_camera(state, look)
    in_camera = transform_points(invert(T), state.table.points(place))
    plain, by_camera = _normalised(in_camera)
    by_world = by_camera @ T[:3, :3].T
    seen, by_plain = plain, np.broadcast_to(np.eye(2), (len(xy), 2, 2))
    if field is not None:
        displaced = field.refinement(state.field)
        seen, by_plain = displaced.apply(plain), displaced.slopes(displaced.scaled(plain))
    g = by_plain @ by_world
    in_plane = g[..., :2] + g[..., 2:] * state.table.slopes(place)[:, None]
    slopes = _of_camera_pose(state, by_plain @ by_camera, in_camera)
    slopes["table"] = g[..., 2:] * state.table.basis(place)[:, None]
    slopes["tcp"] = in_plane @ turn
    slopes["place"] = in_plane
    if field is not None:
        slopes["field"] = field.slopes(plain)
    return Picture(seen, slopes)


def light_on_table(state: JointState, look: Array, field: Field | None, pixels: Array) -> Picture:
    """Of the light of projector pixels (n, 2)."""
    if isinstance(state.projector, ProjectorMap):
        plain = _by_map(state.projector, pixels)
    else:
        plain = _by_rays(state, look, pixels)
    if field is None:
        return plain
    bend = field.refinement(state.bend)
    by_plain = bend.slopes(bend.scaled(plain.xy))
    slopes = {name: by_plain @ slope for name, slope in plain.slopes.items()}
    return Picture(bend.apply(plain.xy), {**slopes, "bend": field.slopes(plain.xy)})


def _by_rays(state: JointState, look: Array, pixels: Array) -> Picture:
    T = world_camera(state, look)
    ray = _Ray.of(state.full_projector, pixels)
    points = state.table.hit(state.full_projector.pose[:3, 3], ray.directions)
    normals = np.column_stack([-state.table.slopes(points[:, :2]), np.ones(len(points))])
    in_camera = transform_points(invert(T), points)
    xy, by_camera = _normalised(in_camera)
    g = by_camera @ T[:3, :3].T
    along = _along(g, ray.directions, normals)
    slopes = _of_camera_pose(state, by_camera, in_camera)
    slopes["projector"] = ray.slopes(points, g - along * normals[:, None])
    slopes["table"] = along * state.table.basis(points[:, :2])[:, None]
    return Picture(xy, slopes)


def light_on_board(
    state: JointState, chain: Chain, view: int, board: str, correction: Array, pixels: Array
) -> Picture:
    """Of the light of projector pixels (n, 2) on the board of the chain's view, whose correction
    is (4, 4). With a camera on the arm the board stands still and the camera moves."""
    to_hand = bool(np.array_equal(chain.after[view], np.eye(4)))
    before, after = chain.before[view], chain.after[view]
    board_state = state.boards[board]
    outer = state.robot_off @ before @ correction @ after
    T_world_board = (outer if to_hand else np.eye(4)) @ board_state.pose
    to_camera = invert(state.camera_pose) @ (np.eye(4) if to_hand else outer)
    ray = _Ray.of(state.full_projector, pixels)
    on_board, normals = _hit_board(chain, board_state, T_world_board, ray)
    points = transform_points(T_world_board, on_board)
    in_camera = transform_points(to_camera, points)
    xy, by_camera = _normalised(in_camera)
    g = by_camera @ to_camera[:3, :3]
    world_normals = normals @ T_world_board[:3, :3].T
    along = _along(g, ray.directions, world_normals)
    slopes = {
        "pose": -derivatives_by_pose(by_camera, in_camera),
        "projector": ray.slopes(points, g - along * world_normals[:, None]),
        f"{board} pose": derivatives_by_pose(along * normals[:, None], on_board),
    }
    slopes |= _of_print(chain, board_state, board, on_board, along)
    by_points = along * (normals @ board_state.pose[:3, :3].T)[:, None]
    moved = transform_points(board_state.pose, on_board)
    if to_hand:
        by_robot = along * (world_normals @ state.robot_off[:3, :3])[:, None]
        in_base = transform_points(invert(state.robot_off), points)
        slopes["robot"] = derivatives_by_pose(by_robot, in_base)
    else:
        by_points = by_camera @ (invert(state.camera_pose) @ correction)[:3, :3]
        moved = transform_points(after, points)
    return Picture(xy, slopes, derivatives_by_pose(by_points, moved))


def _of_camera_pose(state: JointState, by_camera: Array, in_camera: Array) -> dict[str, Array]:
    anchor = transform_points(state.camera_pose, in_camera)
    return {
        "pose": -derivatives_by_pose(by_camera, in_camera),
        "look": -derivatives_by_pose(by_camera @ state.camera_pose[:3, :3].T, anchor),
    }


def _normalised(points: Array) -> tuple[Array, Array]:
    """x/z, y/z (n, 2) of points (n, 3), and the derivatives (n, 2, 3); not-a-number behind."""
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    xy = points[:, :2] / z[:, None]
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, [0, 1], [0, 1]] = 1.0 / z[:, None]
    by_point[:, :, 2] = -xy / z[:, None]
    return xy, by_point


def _along(g: Array, directions: Array, normals: Array) -> Array:
    """(n, 2, 1): the picture's change when the surface is raised by a unit of its equation."""
    steep = (directions * normals).sum(axis=1)
    return g @ (directions / steep[:, None])[..., None]


def _by_map(projector: ProjectorMap, pixels: Array) -> Picture:
    """F(xy, unknowns) = pixels: dxy = -(dF/dxy)^-1 dF."""
    xy = projector.locate(pixels)
    ideal, by_H = homography_jacobian(projector.H, xy)
    by_xy, columns = homography_slopes(projector.H, xy), [by_H]
    if projector.focal_px != 1.0:
        _, by_ideal, by_radial, by_centre = projector.lens_jacobians(ideal)
        by_xy, columns = by_ideal @ by_xy, [by_ideal @ by_H, by_radial, by_centre]
    return Picture(xy, {"projector": -np.linalg.inv(by_xy) @ np.concatenate(columns, axis=-1)})


@dataclass(frozen=True, eq=False)
class _Ray:
    """Rays of projector pixels: normalised (n, 2), in the world (n, 3), and the derivatives
    (n, 2, 5) of the former by focal length, centre, k1 and k2."""

    projector: FullProjector
    normalised: Array
    directions: Array
    by_lens: Array

    @classmethod
    def of(cls, projector: FullProjector, pixels: Array) -> _Ray:
        lens = projector.lens
        warped, xy = lens.plane(pixels), lens.normalise(pixels)
        inverse = np.linalg.inv(distort_slopes(xy, lens.distortion)[1])
        by_plane = np.concatenate(
            [
                -warped[..., None] / lens.K[0, 0],
                np.broadcast_to(-np.eye(2) / lens.K[0, 0], (len(xy), 2, 2)),
                -coefficient_slopes(xy)[..., :2],
            ],
            axis=-1,
        )
        directions = np.column_stack([xy, np.ones(len(xy))]) @ projector.pose[:3, :3].T
        return cls(projector, xy, directions, inverse @ by_plane)

    def slopes(self, points: Array, by_point: Array) -> Array:
        """(n, 2, 11) by the projector's unknowns, from derivatives (n, 2, 3) by world points that
        may slide along their surface."""
        turned = by_point @ self.projector.pose[:3, :3]
        local = transform_points(invert(self.projector.pose), points)
        by_lens = turned[..., :2] * local[:, 2, None, None] @ self.by_lens
        return np.concatenate([by_lens, derivatives_by_pose(turned, local)], axis=-1)


def _hit_board(
    chain: Chain, board: BoardState, T_world_board: Array, ray: _Ray
) -> tuple[Array, Array]:
    """Board points (n, 3) where rays meet a board, and normals (n, 3) there, both in its frame."""
    inverse = invert(T_world_board)
    origin = transform_points(inverse, ray.projector.pose[:3, 3])
    directions = ray.directions @ inverse[:3, :3].T
    points = origin - directions * (origin[2] / directions[:, 2])[:, None]
    for _ in range(4):
        lift, slopes = _bend(chain, board, points)
        steep = directions[:, 2] - (slopes * directions[:, :2]).sum(axis=1)
        points = points + directions * ((lift - points[:, 2]) / steep)[:, None]
    return points, np.column_stack([-_bend(chain, board, points)[1], np.ones(len(points))])


def _bend(chain: Chain, board: BoardState, points: Array) -> tuple[Array, Array]:
    """How far the print lies above the board's plane (n,) at points (n, 3), and its slopes."""
    scale = np.exp(board.log_scale)
    u, v = ((points[:, :2] / scale - chain.sheet.centre) / chain.sheet.half).T
    a, b, c = board.warp
    slopes = np.stack([-2 * u * a + v * c, -2 * v * b + u * c], axis=-1)
    return chain.sheet.lift(points / scale) @ board.warp, slopes / (chain.sheet.half * scale)


def _of_print(
    chain: Chain, board: BoardState, name: str, points: Array, along: Array
) -> dict[str, Array]:
    """By the board's scale and warp, which raise its surface."""
    shrunk = -(_bend(chain, board, points)[1] * points[:, :2]).sum(axis=1)
    lift = chain.sheet.lift(points / np.exp(board.log_scale))
    return {
        f"{name} scale": along * shrunk[:, None, None],
        f"{name} warp": along * lift[:, None],
    }
