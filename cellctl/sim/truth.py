"""What is true in a simulated cell: everything that a seed draws, and where light and pen land.

Frames: `world` is the robot's base as its controller reports it; all lengths in metres. Nothing
outside `cellctl.sim` and the code that scores a run may read this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.arms import JOINTS, ArmModel, arm
from cellctl.geometry import Array, Transform, look_down, pose_matrix
from cellctl.sim.lens import Lens
from cellctl.sim.paper import Sheet
from cellctl.sim.presets import BoardPreset, CameraPreset, Preset, ProjectorPreset, TablePreset

Rng = np.random.Generator
STREAMS = (
    "arm",
    "camera",
    "projector",
    "table",
    "checkerboard",
    "markers",
    "pen",
    "tape",
    "touch",
    "ring",
)
RING_HZ = (8.0, 12.0)


@dataclass(frozen=True, eq=False)
class Table:
    """A tilted plane with a parabolic bow: z = bow (1 - |uv - off|^2 / 2) in its own frame,
    u and v running from -1 to 1 over the lit area."""

    pose: Transform  # T_world_table, origin at the lit area's centre, z up
    half_lit: Array  # (2,) metres
    bow: float
    off: Array  # (2,) in units of the half extents
    half_top: Array  # (2,) metres: the table top, of which light covers a part

    def height(self, xy: Array) -> Array:
        """Height of the surface (...,) above the table's plane at table xy (..., 2)."""
        uv = xy / self.half_lit - self.off
        return self.bow * (1.0 - (uv**2).sum(-1) / 2.0)

    def hit(self, origin: Array, directions: Array) -> Array:
        """Where rays from `origin` (3,) or (..., 3) along `directions` (..., 3) meet the surface,
        world."""
        inverse = self.pose.inverse()
        start = inverse.apply(origin)
        rays = directions @ inverse.rotation.T
        points = start - rays * (start[..., 2:] / rays[..., 2:])
        for _ in range(3):
            lift = (self.height(points[..., :2]) - points[..., 2]) / rays[..., 2]
            points = points + rays * lift[..., None]
        return self.pose.apply(points)

    def surface(self, xy: Array) -> Array:
        """World points (..., 3) on the surface at table xy (..., 2)."""
        return self.pose.apply(np.concatenate([xy, self.height(xy)[..., None]], axis=-1))


@dataclass(frozen=True, eq=False)
class Board:
    """A printed board on the bracket: pose, printed scale (1 = as stated) and bend in metres.

    `centre` (2,) and `half` (2,) span the printed area in board coordinates, nominal metres.
    """

    name: str
    pose: Transform  # T_flange_<name>
    scale: float
    bend: float
    centre: Array
    half: Array

    def surface(self, nominal: Array) -> Array:
        """True board coordinates (..., 3) of nominal printed points (..., 2).

        The sheet is bent along its longer side: a parabola of `bend` metres from middle to end.
        """
        axis = int(np.argmax(self.half))
        along = (nominal[..., axis] - self.centre[axis]) / self.half[axis]
        return np.concatenate(
            [nominal * self.scale, (self.bend * (1.0 - along**2))[..., None]], axis=-1
        )


@dataclass(frozen=True, eq=False)
class Device:
    """A lens at a pose: camera or projector. `pose` is T_world_<optical frame>."""

    lens: Lens
    pose: Transform

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of world points (..., 3)."""
        return self.lens.project(self.pose.inverse().apply(points))

    def rays(self, pixels: Array) -> Array:
        """World directions (..., 3), z = 1 in the optical frame, of pixels (..., 2)."""
        return self.lens.rays(pixels) @ self.pose.rotation.T


@dataclass(frozen=True, eq=False)
class Truth:
    """One drawn cell. `nominal_arm` is what the controller believes, `arm` what is bolted there."""

    preset: Preset
    seed: int
    nominal_arm: ArmModel
    arm: ArmModel
    camera: Device
    projector: Device
    table: Table
    boards: dict[str, Board]
    pen: Array  # true pen tip in the flange frame (3,)
    nominal_pen: Array  # as the config states it (3,)
    ring_hz: float  # at which the arm rings when it has braked
    sheets: tuple[Sheet, ...]  # paper on the table, upper ones last

    def light_lands(self, pixels: Array) -> Array:
        """World points (..., 3) on the table that projector pixels (..., 2) light."""
        return self.table.hit(self.projector.pose.translation, self.projector.rays(pixels))

    def pen_lands(self, xy: Array, joints: Array) -> Array:
        """World points (n, 3) where the pen stands when the controller reports it at `xy`.

        `joints` (n, 6) are those at which the nominal pen tip is at `xy` in its drawing posture
        (see `drawing_pose`). The pen comes down along its own axis until it meets the table.
        """
        flange = self.arm.forward(joints)
        tips = flange[:, :3, :3] @ self.pen + flange[:, :3, 3]
        return self.table.hit(tips, flange[:, :3, 2]).reshape(len(xy), 3)

    def drawing_pose(self, xy: Array, height: float, yaw: float = 0.0) -> Array:
        """Nominal T_world_flange (n, 4, 4) with the pen straight down on (x, y, height)."""
        flange = pose_matrix((np.pi, 0.0, 0.0), (0.0, 0.0, 0.0))
        turn = pose_matrix((0.0, 0.0, yaw), (0.0, 0.0, 0.0))
        poses = np.tile(turn @ flange, (len(xy), 1, 1))
        tips = np.column_stack([xy, np.full(len(xy), height)])
        poses[:, :3, 3] = tips - poses[:, :3, :3] @ self.nominal_pen
        return poses


def draw(preset: Preset, seed: int) -> Truth:
    """The cell that `seed` draws from `preset`. Each part has a random stream of its own."""
    rng = {name: np.random.default_rng([seed, i]) for i, name in enumerate(STREAMS)}
    nominal = arm(preset.arm)
    pen = np.array([0.0, 0.0, preset.boards.pen_m])
    table = _table(preset.table, preset.projector, rng["table"])
    return Truth(
        preset=preset,
        seed=seed,
        nominal_arm=nominal,
        arm=_true_arm(preset, nominal, rng["arm"]),
        camera=_camera(preset.camera, preset.table, rng["camera"]),
        projector=_projector(preset.projector, preset.table, rng["projector"]),
        table=table,
        boards={
            name: _board(name, preset.boards, rng[name]) for name in ("checkerboard", "markers")
        },
        pen=pen + rng["pen"].normal(0.0, preset.pen_sigma_m, 3),
        nominal_pen=pen,
        ring_hz=float(rng["ring"].uniform(*RING_HZ)),
        sheets=(laid_sheet(preset, table, 0),),
    )


def _true_arm(preset: Preset, nominal: ArmModel, rng: Rng) -> ArmModel:
    errors = preset.arm_errors
    return nominal.perturbed(
        theta=np.radians(rng.normal(0.0, errors.zero_sigma_deg, JOINTS)),
        d=rng.normal(0.0, errors.length_sigma_m, JOINTS),
        a=rng.normal(0.0, errors.length_sigma_m, JOINTS),
        alpha=np.radians(rng.normal(0.0, errors.twist_sigma_deg, JOINTS)),
    )


def _camera(preset: CameraPreset, table: TablePreset, rng: Rng) -> Device:
    focal = np.array(preset.focal_px) + rng.normal(0.0, preset.pixel_sigma, 2)
    centre = np.array(preset.centre_px) + rng.normal(0.0, preset.pixel_sigma, 2)
    distortion = np.array(preset.distortion)
    distortion[:2] *= 1.0 + rng.normal(0.0, preset.radial_spread, 2)
    tilt = np.radians(np.array(preset.tilt_deg) + rng.normal(0.0, preset.tilt_sigma_deg, 2))
    aim = np.array(table.centre_m) + (*rng.normal(0.0, preset.aim_sigma_m, 2), 0.0)
    pose = _hang(aim, preset.height_m, tilt, np.radians(preset.yaw_deg), np.array([0.0, 0.0, 1.0]))
    lens = Lens(preset.size_px, focal, centre, distortion)
    return Device(lens, Transform("world", "camera", pose))


def _projector(preset: ProjectorPreset, table: TablePreset, rng: Rng) -> Device:
    width, height = preset.size_px
    focal = np.full(2, preset.throw_ratio * width)
    centre = np.array(preset.centre_px) + rng.normal(0.0, preset.centre_sigma_px)
    tilt = np.radians(np.array(preset.tilt_deg) + rng.normal(0.0, preset.tilt_sigma_deg, 2))
    lens = Lens(preset.size_px, focal, centre, np.array([*preset.distortion, 0.0, 0.0, 0.0]))
    middle = lens.rays(np.array([[(width - 1) / 2, (height - 1) / 2]]))[0]
    yaw = np.radians(preset.yaw_deg)
    pose = _hang(np.array(table.centre_m), preset.distance_m, tilt, yaw, middle)
    return Device(lens, Transform("world", "projector", pose))


def _hang(aim: Array, height: float, tilt: Array, yaw: float, ray: Array) -> Array:
    """An optical frame that looks down, tilted about its own x and y, `height` above `aim`, so
    that `ray` (3,), given in that frame, meets `aim`."""
    down = look_down((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), yaw)
    pose = pose_matrix((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    tilted = pose_matrix((tilt[0], 0.0, 0.0), (0, 0, 0)) @ pose_matrix(
        (0.0, tilt[1], 0.0), (0, 0, 0)
    )
    pose[:3, :3] = down[:3, :3] @ tilted[:3, :3]
    direction = pose[:3, :3] @ ray
    pose[:3, 3] = aim - direction * (height / -direction[2])
    return pose


def _table(preset: TablePreset, projector: ProjectorPreset, rng: Rng) -> Table:
    tilt = rng.normal(0.0, preset.tilt_sigma_rad, 2)
    turn = pose_matrix((0, 0, np.radians(projector.yaw_deg)), (0, 0, 0))
    pose = pose_matrix((*tilt, 0.0), preset.centre_m) @ turn
    width = projector.distance_m / projector.throw_ratio
    half = np.array([width, width * projector.size_px[1] / projector.size_px[0]]) / 2
    off = preset.bow_off_centre * rng.choice((-1.0, 1.0), 2)
    bow = preset.bow_m * float(rng.choice((-1.0, 1.0)))
    turned = np.abs(turn[:2, :2].T) @ (np.array(preset.top_m) / 2)
    return Table(Transform("world", "table", pose), half, bow, off, turned)


def sheet_rectangle(preset: Preset) -> tuple[Array, Array]:
    """Lower and upper corner (2,) in world x, y of the paper as a person lays it."""
    centre = np.array(preset.table.centre_m[:2])
    half = np.array(preset.table.area_m) / 2 + preset.table.sheet_margin_m
    return centre - half, centre + half


def laid_sheet(preset: Preset, table: Table, number: int) -> Sheet:
    """Paper as a person lays it, along the world's axes."""
    low, high = sheet_rectangle(preset)
    middle = (*((low + high) / 2), preset.table.centre_m[2])
    along = table.pose.rotation.T[:2, 0]
    turn = float(np.arctan2(along[1], along[0]))
    return Sheet("A", number, table.pose.inverse().apply(middle)[:2], turn, (high - low) / 2)


def _board(name: str, preset: BoardPreset, rng: Rng) -> Board:
    pose, centre, half = bracket(preset)[name]
    low, high = preset.scale_off
    scale = 1.0 + float(rng.uniform(low, high) * rng.choice((-1.0, 1.0)))
    bend = preset.bend_m * float(rng.choice((-1.0, 1.0)))
    return Board(name, Transform("flange", name, pose), scale, bend, centre, half)


def bracket(preset: BoardPreset) -> dict[str, tuple[Array, Array, Array]]:
    """Where the bracket holds its boards: name -> (T_flange_board, centre (2,), half size (2,)).

    A tray across the flange: the checkerboard on its +x wing, the markers on its -x wing, both
    facing backwards (board z = flange z), so that they look up while the pen points down; or both
    forwards, turned about the flange's x axis. Board coordinates start at the first inner corner
    and at the first marker's first corner.
    """
    facing = np.diag([1.0, -1.0, -1.0]) if preset.forwards else np.eye(3)
    columns, rows = preset.inner_corners
    square = preset.square_m
    checker_size = np.array([columns - 1, rows - 1]) * square
    checker_half = checker_size / 2 + square
    checker = np.eye(4)
    checker[:3, :3] = facing @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    marker_size = (np.array(preset.markers) - 1) * preset.pitch_m + preset.marker_m
    marker_half = marker_size / 2 + (preset.pitch_m - preset.marker_m)
    markers = np.eye(4)
    markers[:3, :3] = facing
    _centre_at(
        checker, checker_size / 2, (preset.clearance_m + checker_half[1], 0.0, preset.tray_m)
    )
    _centre_at(markers, marker_size / 2, (-preset.clearance_m - marker_half[0], 0.0, preset.tray_m))
    return {
        "checkerboard": (checker, checker_size / 2, checker_half),
        "markers": (markers, marker_size / 2, marker_half),
    }


def _centre_at(pose: Array, centre: Array, place: tuple[float, float, float]) -> None:
    pose[:3, 3] = np.array(place) - pose[:3, :3] @ (*centre, 0.0)


def tape_error(preset: Preset, pose: Array, rng: Rng) -> Array:
    """A pose as a tape measure gives it: off by up to `tape_off_m` and `tape_off_deg`, less what
    rounding it to millimetres and tenths of degrees may add."""
    shift = _direction(rng) * rng.uniform(0.0, 0.99 * preset.tape_off_m)
    turn = _direction(rng) * np.radians(rng.uniform(0.0, 0.99 * preset.tape_off_deg))
    off = pose.copy()
    off[:3, :3] = pose_matrix(turn, (0, 0, 0))[:3, :3] @ pose[:3, :3]
    off[:3, 3] = pose[:3, 3] + shift
    return off


def _direction(rng: Rng) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def score(truth: Truth, xy: Array, joints: Array, pixels: Array) -> dict[str, Any]:
    """`true_mm` and `true_px` of the light `pixels` (n, 2) that were sent for reported `xy`.

    Root mean square of the 2-D distance on the table between where the pen lands and where that
    light lands; in projector pixels, between `pixels` and the pixel that would light the pen.
    """
    pen = truth.pen_lands(xy, joints)
    light = truth.light_lands(pixels)
    gap_mm = 1e3 * np.linalg.norm((light - pen)[:, :2], axis=1)
    gap_px = np.linalg.norm(truth.projector.project(pen) - pixels, axis=1)
    return {
        "true_mm": float(np.sqrt(np.mean(gap_mm**2))),
        "true_px": float(np.sqrt(np.mean(gap_px**2))),
    }


def scoring_grid(preset: Preset) -> Array:
    """The 11 x 11 world points (121, 2) over 110 % of the drawn area."""
    centre = np.array(preset.table.centre_m[:2])
    half = np.array(preset.table.area_m) * 1.1 / 2
    steps = np.linspace(-1.0, 1.0, 11)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return centre + grid * half
