"""What a full run sees of a simulated cell, without pictures: truth plus Gaussian noise, for both
cells and for worlds that are worse than the standard one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from cellctl import ik
from cellctl.calib.calibration import Calibration, Plane
from cellctl.calib.camera import CameraModel
from cellctl.calib.joint.observations import BoardViews, Circles, Lit, LitBoard, Observations
from cellctl.calib.patterns import marker_pictures
from cellctl.calib.projector_map import ProjectorMap, direct_linear_transform
from cellctl.calib.refine_fit import rotations
from cellctl.calib.table_surface import Area
from cellctl.calib.targets import ArucoGrid, Chessboard
from cellctl.calib.views import RobotView
from cellctl.geometry import Array, Transform, invert, pose_matrix
from cellctl.sim.grid import Grid, drawing_joints
from cellctl.sim.presets import PRESETS, Preset
from cellctl.sim.truth import Truth, draw

Rng = np.random.Generator
CORNER_PX, MARKER_PX, CIRCLE_PX, TOUCH_M = 0.07, 0.035, 0.03, 0.03e-3
YAWS = np.radians([0.0, 60.0, -60.0])
HEIGHTS = {"cr": (0.10, 0.35), "ir": (0.25, 0.9)}


def preset_of(
    name: str, *, kinematics: float = 1.0, bow_m: float | None = None, slip_m: float | None = None
) -> Preset:
    """The standard cell, or one that is worse in one way."""
    preset = PRESETS[name]
    arm = preset.arm_errors
    arm = replace(
        arm,
        zero_sigma_deg=arm.zero_sigma_deg * kinematics,
        length_sigma_m=arm.length_sigma_m * kinematics,
        twist_sigma_deg=arm.twist_sigma_deg * kinematics,
    )
    table = preset.table if bow_m is None else replace(preset.table, bow_m=bow_m)
    slip = preset.pen_slip_sigma_m if slip_m is None else slip_m
    return replace(preset, arm_errors=arm, table=table, pen_slip_sigma_m=slip)


@dataclass(frozen=True, eq=False)
class JointWorld:
    """`start` is what a run knows before: values of tape and maker, roughly refined."""

    truth: Truth
    seen: Observations
    start: Calibration
    grid: Grid
    area: Area

    @cached_property
    def pen(self) -> Array:
        return self.truth.pen_lands(self.grid.points[:, :2], self.grid.joints)

    def gaps(self, calibration: Calibration) -> Array:
        """Millimetres (121, 2) from the pen to the light, over the scored grid."""
        light = self.truth.light_lands(calibration.project(self.grid.points))
        return 1e3 * (light - self.pen)[:, :2]

    def score(self, calibration: Calibration) -> float:
        return float(np.sqrt(np.square(self.gaps(calibration)).sum(axis=1).mean()))


def joint_world(
    seed: int,
    preset: Preset | str = "cr",
    *,
    views: tuple[int, int] = (30, 10),
    spots: int = 60,
    repeats: int = 1,
    lit_boards: int = 0,
    noise: float = 1.0,
) -> JointWorld:
    """`spots` distinct places of circles, each drawn `repeats` times; `lit_boards` of the
    hand-eye views also show projected points; `noise` scales that of corners and marks."""
    preset = preset_of(preset) if isinstance(preset, str) else preset
    truth = draw(preset, seed)
    rng = np.random.default_rng([seed, 1717])
    grid = Grid(truth)
    sizes = preset.boards
    boards = {
        "checkerboard": Chessboard(sizes.inner_corners, sizes.square_m).points,
        "markers": ArucoGrid(sizes.markers, sizes.marker_m, sizes.pitch_m, sizes.dictionary).points,
    }
    home = drawing_joints(truth, np.array([preset.table.centre_m[:2]]), grid.height)[0]
    seen_views = [
        _views(truth, name, boards[name], count, home, rng, noise)
        for name, count in zip(boards, views, strict=True)
    ]
    groups = [
        BoardViews("intrinsic views", "checkerboard", [v for v, _ in seen_views[0]]),
        BoardViews("hand-eye views", "markers", [v for v, _ in seen_views[1]]),
    ]
    xy, yaw = _layout(truth, spots, repeats, rng)
    half = np.array(preset.table.area_m) / 2 * 1.1
    middle = np.array(preset.table.centre_m[:2])
    markers = _markers(truth, rng, noise)
    seen = Observations(
        views=groups,
        touches=_touches(truth, grid, home, rng, noise),
        markers=markers,
        lit_boards=[
            _lit_board(truth, boards["markers"], view, pose, rng, noise)
            for view, pose in seen_views[1][:lit_boards]
        ],
        circles=_circles(truth, xy, yaw, home, grid, rng, noise),
    )
    start = _start(truth, seen, grid, rng)
    return JointWorld(truth, seen, start, grid, Area(middle - half, middle + half))


def _views(
    truth: Truth, name: str, points: Array, count: int, home: Array, rng: Rng, noise: float
) -> list[tuple[RobotView, Array]]:
    """Views, each with the board's true pose in the world."""
    found: list[tuple[RobotView, Array]] = []
    errors, board = truth.preset.arm_errors, truth.boards[name]
    while len(found) < count:
        wanted = _flanges(truth, 12 * count, rng)
        joints, converged = ik.refine(truth.nominal_arm, wanted, np.tile(home, (len(wanted), 1)))
        for q in joints[converged & truth.nominal_arm.within_limits(joints)]:
            turn = rng.normal(0.0, np.radians(errors.repeat_sigma_deg), 3)
            repeat = pose_matrix(turn, rng.normal(0.0, errors.repeat_sigma_m, 3))
            pose = truth.arm.forward(q) @ repeat @ board.pose.matrix
            world = Transform("world", "board", pose).apply(board.surface(points[:, :2]))
            if _faces(truth, pose) and len(found) < count:
                pixels = truth.camera.project(world)
                if _inside(truth, pixels, 15):
                    pixels = pixels + rng.normal(0.0, noise * CORNER_PX, pixels.shape)
                    reported = Transform("world", "flange", truth.nominal_arm.forward(q))
                    id_ = f"{name}-{len(found):02d}"
                    found.append((RobotView(id_, points, pixels, reported), pose))
    return found


def _flanges(truth: Truth, count: int, rng: Rng) -> Array:
    """Flange poses all over the table, the pen pointing down but for a tilt."""
    preset = truth.preset
    half, (low, high) = np.array(preset.table.area_m) / 2, HEIGHTS[preset.name]
    poses = []
    for _ in range(count):
        xy = preset.table.centre_m[:2] + rng.uniform(-1, 1, 2) * half
        tilt, about = np.radians(rng.uniform(10, 40)), rng.uniform(0, 2 * np.pi)
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
        turn = turn * Rotation.from_euler("z", rng.uniform(-np.pi / 3, np.pi / 3))
        turn = turn * Rotation.from_rotvec([np.pi, 0.0, 0.0])
        z = preset.table.centre_m[2] + rng.uniform(low, high) + preset.boards.pen_m
        poses.append(pose_matrix(turn.as_rotvec(), (*xy, z)))
    return np.array(poses)


def _faces(truth: Truth, pose: Array) -> bool:
    """Whether the printed side (-z or +z of the board, towards the camera) is seen at less than
    50 degrees; boards show themselves where their x and y make a right-handed picture."""
    ray = truth.camera.pose.translation - pose[:3, 3]
    return bool(abs(pose[:3, 2] @ ray) > np.cos(np.radians(50)) * np.linalg.norm(ray))


def _inside(truth: Truth, pixels: Array, margin: float) -> bool:
    size = np.array(truth.camera.lens.size)
    return bool(np.all((pixels > margin) & (pixels < size - margin)))


def _layout(truth: Truth, spots: int, repeats: int, rng: Rng) -> tuple[Array, Array]:
    """Jittered grid over the drawn area, yaws changing from one circle to the next."""
    half = np.array(truth.preset.table.area_m) / 2
    columns = max(int(np.ceil(np.sqrt(spots * half[0] / half[1]))), 2)
    rows = int(np.ceil(spots / columns))
    steps = np.stack(
        np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)), axis=-1
    ).reshape(-1, 2)
    steps = steps[rng.permutation(len(steps))[:spots]]
    pitch = 2.0 / (np.array([columns, rows]) - 1)
    places = np.clip(steps + rng.uniform(-0.35, 0.35, steps.shape) * pitch, -1, 1)
    xy = np.tile(truth.preset.table.centre_m[:2] + places * half, (repeats, 1))
    yaw = YAWS[(np.arange(len(xy)) + np.arange(len(xy)) // spots) % 3]
    return xy, yaw


def _joints(truth: Truth, xy: Array, yaw: Array, height: float, home: Array) -> Array:
    poses = np.concatenate(
        [truth.drawing_pose(p[None], height, y) for p, y in zip(xy, yaw, strict=True)]
    )
    joints, converged = ik.refine(truth.nominal_arm, poses, home + np.outer(-yaw, np.eye(6)[5]))
    assert converged.all()
    return joints


def _circles(
    truth: Truth, xy: Array, yaw: Array, home: Array, grid: Grid, rng: Rng, noise: float
) -> Circles:
    pen = truth.pen_lands(xy, _joints(truth, xy, yaw, grid.height, home))
    errors = truth.preset.arm_errors
    turned = truth.preset.boards.pen_m * np.radians(errors.drawing_repeat_sigma_deg)
    sigma = np.sqrt(truth.preset.pen_slip_sigma_m**2 + errors.repeat_sigma_m**2 + turned**2)
    pen[:, :2] += noise * rng.normal(0.0, sigma, (len(xy), 2))
    pixels = truth.camera.project(pen) + rng.normal(0.0, noise * CIRCLE_PX, (len(xy), 2))
    return Circles(tuple(f"circle-{i:03d}" for i in range(len(xy))), xy, yaw, pixels)


def _touches(truth: Truth, grid: Grid, home: Array, rng: Rng, noise: float) -> Array:
    """Nine touches over the area, with the arm's own error in height."""
    half = np.array(truth.preset.table.area_m) / 2
    steps = np.stack(np.meshgrid(*[[-0.9, 0.0, 0.9]] * 2), axis=-1).reshape(-1, 2)
    xy = truth.preset.table.centre_m[:2] + steps * half
    joints = _joints(truth, xy, np.zeros(len(xy)), grid.height, home)
    flange = truth.arm.forward(joints)
    tips = flange[:, :3, :3] @ truth.pen + flange[:, :3, 3]
    table = truth.table.hit(tips, np.tile([0.0, 0.0, -1.0], (len(tips), 1)))
    z = grid.height - (tips - table)[:, 2] + rng.normal(0.0, noise * TOUCH_M, len(xy))
    return np.column_stack([xy, z])


def _markers(truth: Truth, rng: Rng, noise: float) -> Lit:
    pictures = marker_pictures(truth.projector.lens.size)
    centres = np.array([c for picture in pictures for c in picture.centres.values()])
    pixels = truth.camera.project(truth.light_lands(centres))
    pixels = pixels + rng.normal(0.0, noise * MARKER_PX, pixels.shape)
    size = np.array(truth.camera.lens.size)
    inside = np.all((pixels > 5) & (pixels < size - 5), axis=1)
    return Lit(centres[inside], pixels[inside])


def _lit_board(
    truth: Truth, points: Array, view: RobotView, pose: Array, rng: Rng, noise: float
) -> LitBoard:
    """A grid of projected points that fall on the board of a view."""
    board = truth.boards["markers"]
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    steps = np.stack(np.meshgrid(*[np.linspace(0.1, 0.9, 5)] * 2), axis=-1).reshape(-1, 2)
    world = Transform("world", "board", pose).apply(board.surface(low + steps * (high - low)))
    light = truth.projector.project(world)
    pixels = truth.camera.project(world) + rng.normal(0.0, noise * MARKER_PX, light.shape)
    return LitBoard("hand-eye views", view.id, Lit(light, pixels))


def _start(truth: Truth, seen: Observations, grid: Grid, rng: Rng) -> Calibration:
    """Roughly right, as the single steps leave a cell."""
    lens = truth.camera.lens
    vector = np.array([*lens.focal, *lens.centre, *lens.distortion])
    vector[:4] += rng.normal(0.0, 1.0, 4)
    vector[4:] *= 0.98
    camera = CameraModel.from_vector(vector, lens.size)
    off = pose_matrix(rng.normal(0.0, np.radians(0.1), 3), rng.normal(0.0, 2e-3, 3))
    pose = Transform("world", "camera", truth.camera.pose.matrix @ off)
    H = direct_linear_transform(camera.normalise(seen.markers.camera_px), seen.markers.projector_px)
    preset = truth.preset.projector
    focal = preset.throw_ratio * preset.size_px[0]
    projector = ProjectorMap(H, np.array(preset.centre_px), focal, np.zeros(2))
    return Calibration(camera, pose, Plane.horizontal(grid.height), projector)


def true_tcp(world: JointWorld) -> Array:
    """The offset (2,), metres, that turns with the tool, as far as drawing shows it: beside the
    pen's that of the last link."""
    truth, grid = world.truth, world.grid
    home = drawing_joints(truth, np.array([truth.preset.table.centre_m[:2]]), grid.height)[0]
    yaw = np.radians([0.0, 60.0, -60.0, 30.0, -30.0])
    xy = np.tile(truth.preset.table.centre_m[:2], (len(yaw), 1))
    pen = truth.pen_lands(xy, _joints(truth, xy, yaw, grid.height, home))[:, :2]
    design = np.concatenate([rotations(yaw), np.tile(np.eye(2), (len(yaw), 1, 1))], axis=2)
    return np.linalg.lstsq(design.reshape(-1, 4), pen.reshape(-1), rcond=None)[0][:2]


def true_pose_error(truth: Truth, pose: Array) -> Array:
    """T_world_camera's error as a small turn and shift in the camera's frame, (6,)."""
    off = invert(truth.camera.pose.matrix) @ pose
    return np.concatenate([Rotation.from_matrix(off[:3, :3]).as_rotvec(), off[:3, 3]])
