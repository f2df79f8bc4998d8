"""The unknowns of the joint adjustment, their places in its vector, and the table and projector
as it knows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cellctl.calib.camera import CameraModel
from cellctl.calib.plane import Plane
from cellctl.calib.pose import pose_matrices
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refinement import Refinement, kernel_values
from cellctl.calib.table_surface import TERMS, Area, basis
from cellctl.geometry import Array, invert


@dataclass(frozen=True, eq=False)
class BoardState:
    """A board on its mount: T_mount_board (4, 4), logarithm of its scale, warp (3,) in metres."""

    pose: Array
    log_scale: float
    warp: Array


@dataclass(frozen=True, eq=False)
class Table:
    """z(x, y) of the world, metres: `coefficients` times table_surface.basis over `area`."""

    area: Area
    kind: str
    coefficients: Array

    @classmethod
    def of_plane(cls, plane: Plane, area: Area, kind: str = "plane") -> Table:
        corners = np.array([area.low, (area.high[0], area.low[1]), (area.low[0], area.high[1])])
        z = plane.height(corners)
        half = (z[1:] - z[0]) / 2.0
        coefficients = np.zeros(TERMS[kind])
        coefficients[:3] = z[0] + half.sum(), *half
        return cls(area, kind, coefficients)

    def basis(self, xy: Array) -> Array:
        """(n, t) at xy (n, 2)."""
        return basis(xy, self.area, self.kind)

    def height(self, xy: Array) -> Array:
        """(n,) at xy (n, 2)."""
        return self.basis(xy) @ self.coefficients

    def slopes(self, xy: Array) -> Array:
        """Derivatives (n, 2) of the height by x and y."""
        middle, half = (self.area.low + self.area.high) / 2, (self.area.high - self.area.low) / 2
        u, v = ((xy - middle) / half).T
        zero, one = np.zeros_like(u), np.ones_like(u)
        by_u = np.stack([zero, one, zero, 2 * u, zero, v], axis=-1)
        by_v = np.stack([zero, zero, one, zero, 2 * v, u], axis=-1)
        count = len(self.coefficients)
        both = np.stack([by_u[:, :count], by_v[:, :count]], axis=1) @ self.coefficients
        return both / half

    def points(self, xy: Array) -> Array:
        """World points (n, 3) above xy (n, 2)."""
        return np.column_stack([xy, self.height(xy)])

    def hit(self, origin: Array, rays: Array) -> Array:
        """World points (n, 3) where lines from origin (3,) along rays (n, 3) meet the table."""
        flat = replace(self, kind="plane", coefficients=self.coefficients[:3]).plane
        points = flat.intersect(origin, rays)
        for _ in range(4 if self.kind != "plane" else 0):
            gap = self.height(points[:, :2]) - points[:, 2]
            slope = rays[:, 2] - (self.slopes(points[:, :2]) * rays[:, :2]).sum(axis=1)
            points = points + rays * (gap / slope)[:, None]
        return points

    @property
    def plane(self) -> Plane:
        """Without the bow: the plane nearest to the surface over `area`."""
        middle, half = (self.area.low + self.area.high) / 2, (self.area.high - self.area.low) / 2
        normal = np.append(-self.coefficients[1:3] / half, 1.0)
        point = np.append(middle, self.coefficients[0])
        return Plane(point, normal / np.linalg.norm(normal))


@dataclass(frozen=True, eq=False)
class FullProjector:
    """A projector as a camera that runs backwards: `lens` (fx = fy, k1 and k2 only) at `pose`
    T_world_projector (4, 4). Right off the table as well."""

    lens: CameraModel
    pose: Array

    def project(self, points: Array) -> Array:
        """Projector pixels (n, 2) that light the world points (n, 3)."""
        inverse = invert(self.pose)
        return self.lens.project(points @ inverse[:3, :3].T + inverse[:3, 3])


@dataclass(frozen=True, eq=False)
class Field:
    """Smooth displacements in the camera's plane that no parameter explains: what the arm's
    kinematic errors do to drawn circles, and the table's bow to light. A Gaussian process with
    the kernel exp(-r^2 / 2 length^2), r in units of `scale` about `centre`, written as `modes`
    (k, m) of the radial functions about `nodes` (k, 2): Rasmussen, Williams, Gaussian Processes
    for Machine Learning, 2006, section 8.1. `mm`: millimetres on the table of one `scale`."""

    centre: Array
    scale: float
    mm: float
    length: float
    nodes: Array
    modes: Array

    @property
    def count(self) -> int:
        return int(self.modes.shape[1])

    def values(self, xy: Array) -> Array:
        """(n, m): what unit coefficients displace camera coordinates (n, 2) by, per mm."""
        u = (xy - self.centre) / self.scale
        phi = kernel_values("rbf", self.length, u, self.nodes)
        return phi @ self.modes * (self.scale / self.mm)

    def slopes(self, xy: Array) -> Array:
        """`values` as derivatives (n, 2, 2 m) of both coordinates by all coefficients."""
        both = self.values(xy)[:, None, :, None] * np.eye(2)[:, None, :]
        return both.reshape(len(xy), 2, -1)

    def refinement(self, coefficients: Array) -> Refinement:
        """The displacement with coefficients (m, 2) in mm, as calibrations store it."""
        weights = self.modes @ coefficients / self.mm
        return Refinement(
            "joint",
            self.centre,
            self.scale,
            kernel="rbf",
            length=self.length,
            nodes=self.nodes,
            weights=weights,
        )


@dataclass(frozen=True, eq=False)
class JointState:
    """`camera_pose` is T_anchor_camera, the anchor being the world or the flange.

    `tcp` (2,) m, how far the pen's tip is from where it is believed, in world axes at yaw 0;
    `level` (3,) m, what is to be added to heights that were felt: in the middle of the table's
    area, for the pen's length, and at its edges in x and y, for the arm's error;
    `field` and `bend` (m, 2) mm, the smooth displacements of what is drawn and of what is lit;
    `corrections` (n, 4, 4) of all views. `robot_off` (4, 4) is how far the robot is off in all
    views alike, against where it is off at the table: T_world_flange = robot_off @ reported @
    correction. With the camera on the arm, `look_off` (4, 4) is how far it was off as it looked at
    the table: T_world_flange = reported @ look_off.
    """

    camera: CameraModel
    camera_pose: Array
    boards: Mapping[str, BoardState]
    table: Table
    projector: ProjectorMap | FullProjector
    tcp: Array
    level: Array
    field: Array
    bend: Array
    corrections: Array
    robot_off: Array
    look_off: Array

    @property
    def full_projector(self) -> FullProjector:
        assert isinstance(self.projector, FullProjector)
        return self.projector


@dataclass(frozen=True, eq=False)
class Layout:
    """Names and sizes of the global unknowns that are free, in order."""

    sizes: Mapping[str, int]

    @cached_property
    def slices(self) -> dict[str, slice]:
        ends = np.cumsum([0, *self.sizes.values()]).tolist()
        return {
            name: slice(start, end)
            for name, start, end in zip(self.sizes, ends, ends[1:], strict=False)
        }

    @property
    def count(self) -> int:
        return sum(self.sizes.values())

    def __contains__(self, name: str) -> bool:
        return name in self.sizes

    def columns(self, names: list[str]) -> Array:
        """Their places in the vector of unknowns."""
        order = np.arange(self.count)
        return np.concatenate([order[:0], *(order[self.slices[name]] for name in names)])

    def moved(self, state: JointState, step: Array, by_locals: Array) -> JointState:
        """The state moved by (g,) and (n, 6)."""
        part = {name: step[place] for name, place in self.slices.items()}
        boards = {name: _moved_board(board, name, part) for name, board in state.boards.items()}
        return JointState(
            camera=_moved_lens(state.camera, part.get("camera")),
            camera_pose=moved_pose(state.camera_pose, part.get("pose")),
            boards=boards,
            table=replace(
                state.table, coefficients=state.table.coefficients + part.get("table", 0.0)
            ),
            projector=_moved_projector(state.projector, part.get("projector")),
            tcp=state.tcp + part.get("tcp", 0.0),
            level=state.level + part.get("level", 0.0),
            field=state.field + np.reshape(part.get("field", 0.0), (-1, 2)),
            bend=state.bend + np.reshape(part.get("bend", 0.0), (-1, 2)),
            corrections=state.corrections @ pose_matrices(by_locals)
            if by_locals.size
            else state.corrections,
            robot_off=moved_pose(state.robot_off, part.get("robot")),
            look_off=moved_pose(state.look_off, part.get("look")),
        )


def moved_pose(pose: Array, step: Array | None) -> Array:
    return pose if step is None else pose @ pose_matrices(step[None])[0]


def _moved_board(board: BoardState, name: str, part: Mapping[str, Array]) -> BoardState:
    log_scale, warp = part.get(f"{name} scale"), part.get(f"{name} warp")
    return BoardState(
        moved_pose(board.pose, part.get(f"{name} pose")),
        board.log_scale + (0.0 if log_scale is None else float(log_scale[0])),
        board.warp + (0.0 if warp is None else warp),
    )


def _moved_lens(lens: CameraModel, step: Array | None) -> CameraModel:
    if step is None:
        return lens
    vector = lens.vector + step
    vector[:2] = np.maximum(vector[:2], 1.0)
    return CameraModel.from_vector(vector, lens.image_size)


def _moved_projector(
    projector: ProjectorMap | FullProjector, step: Array | None
) -> ProjectorMap | FullProjector:
    """A map by H's entries, k1, k2 and the centre in px; a full one by focal length, centre, k1,
    k2 and its pose."""
    if step is None:
        return projector
    if isinstance(projector, FullProjector):
        vector = np.concatenate([step[[0, 0, 1, 2, 3, 4]], np.zeros(3)])
        return FullProjector(
            _moved_lens(projector.lens, vector), moved_pose(projector.pose, step[5:])
        )
    H = projector.H + np.append(step[:8], 0.0).reshape(3, 3)
    if len(step) == 8:
        return replace(projector, H=H)
    return ProjectorMap(
        H, projector.centre + step[10:], projector.focal_px, projector.radial + step[8:10]
    )
