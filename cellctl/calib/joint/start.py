"""Where the joint adjustment begins: a calibration, and what each view alone says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cellctl.calib.calibration import Calibration
from cellctl.calib.camera import CameraModel
from cellctl.calib.chain import FULL, Chain, Free, Sheet
from cellctl.calib.hand_eye_fit import Mount
from cellctl.calib.joint.noise import OPINIONS, VIEWS
from cellctl.calib.joint.observations import BoardViews, Observations
from cellctl.calib.joint.pictures import pen, world_camera
from cellctl.calib.joint.problem import JointProblem, LensPrior, ViewGroup
from cellctl.calib.joint.resection import resection
from cellctl.calib.joint.state import BoardState, Field, FullProjector, JointState, Layout, Table
from cellctl.calib.pose import board_poses
from cellctl.calib.projector_map import ProjectorMap
from cellctl.calib.refine_fit import rotations
from cellctl.calib.refinement import kernel_values
from cellctl.calib.table_surface import TERMS, Area
from cellctl.calib.views import Batch, RobotView
from cellctl.errors import BadInput, SolveError
from cellctl.geometry import Array, invert, transform_points

FIELD_LENGTH, BEND_LENGTH = 0.8, 1.5
"""Of the smooth displacements of what is drawn and lit, in half the drawn area's longer side."""
FIELD_NODES, FIELD_REACH = 7, 1.3
NEGLIGIBLE_MODE = 1e-4
"""Modes whose variance is below that part of the largest are left out."""
MARGIN = 1.1
"""Of the area that counts about what was drawn in."""
GRID = 11


@dataclass(frozen=True)
class JointOptions:
    """What the adjustment may change. `table`: the kind of surface (table_surface.TERMS);
    `smooth`: displacements of what is drawn, of `field_length` half sides of the area, and lit."""

    camera: bool = True
    scale: bool = True
    warp: bool = True
    table: str = "plane"
    smooth: bool = True
    field_length: float = FIELD_LENGTH


@dataclass(frozen=True, eq=False)
class Located:
    """A group of views with T_camera_board (n, 4, 4) of each, and T_mount_board (4, 4)."""

    group: BoardViews
    in_camera: Array
    board_pose: Array
    before: Array
    after: Array
    sheet: Sheet

    def chain(self, options: JointOptions) -> Chain:
        tied = self.group.through_robot
        free = Free(
            FULL if options.camera else (),
            poses=tied,
            scale=tied and options.scale,
            warp=options.warp,
        )
        return Chain(Batch.of(self.group.views), self.before, self.after, self.sheet, free)

    @property
    def corrections(self) -> Array:
        if not self.group.through_robot:
            return self.in_camera
        return np.broadcast_to(np.eye(4), self.in_camera.shape)


def begin(
    seen: Observations, start: Calibration, options: JointOptions, area: Area | None
) -> tuple[JointProblem, JointState]:
    """The problem with noises as they are thought to be, and the state from which to start.

    BadInput for what does not fit together, SolveError when a view or the light has no start.
    """
    look = np.eye(4) if seen.look is None else seen.look.matrix
    camera_pose = invert(look) @ start.T_world_camera.matrix
    located = [_located(group, seen, start.camera, camera_pose) for group in seen.views]
    boards = {one.group.board: one for one in located}
    boards |= {one.group.board: one for one in located if one.group.through_robot}
    state = JointState(
        camera=start.camera,
        camera_pose=camera_pose,
        boards={n: BoardState(one.board_pose, 0.0, np.zeros(3)) for n, one in boards.items()},
        table=Table.of_plane(start.table, area or _area(seen, start), options.table),
        projector=replace(start.projector, bend=None),
        tcp=np.zeros(2),
        level=np.zeros(3),
        field=np.zeros((0, 2)),
        bend=np.zeros((0, 2)),
        corrections=np.concatenate([np.zeros((0, 4, 4)), *(one.corrections for one in located)]),
        robot_off=np.eye(4),
        look_off=np.eye(4),
    )
    lens = _lens_prior(start.projector)
    if seen.lit_boards:
        state = replace(state, projector=_full_projector(seen, state, located, look, lens))
    return _problem(seen, state, located, look, lens, options)


def _problem(
    seen: Observations,
    state: JointState,
    located: Sequence[Located],
    look: Array,
    lens: LensPrior | None,
    options: JointOptions,
) -> tuple[JointProblem, JointState]:
    field = bend = None
    if options.smooth and len(seen.circles):
        field = _field(state, look, options.field_length)
        state = replace(state, field=np.zeros((field.count, 2)))
    if options.smooth and len(seen.markers):
        bend = _field(state, look, BEND_LENGTH)
        state = replace(state, bend=np.zeros((bend.count, 2)))
    layout = _layout(seen, state, located, options, lens)
    groups = _groups(layout, located, options)
    problem = JointProblem(
        layout=layout,
        groups=groups,
        touches=np.asarray(seen.touches, dtype=float).reshape(-1, 3),
        markers=seen.markers,
        lit=tuple(seen.lit_boards),
        circles=seen.circles,
        mm=_mm(state, look, seen),
        look=look,
        field=field,
        bend=bend,
        lens=lens,
        table_start=state.table.coefficients,
        sigma={group.name: VIEWS.sigma for group in groups}
        | {name: opinion.sigma for name, opinion in OPINIONS.items()},
    )
    return problem, state


def _located(
    group: BoardViews, seen: Observations, camera: CameraModel, camera_pose: Array
) -> Located:
    """Poses of the board that agree with each other under the camera's pose."""
    every = [v for g in seen.views if g.board == group.board for v in g.views]
    sheet = Sheet.of(np.concatenate([view.points for view in every]))
    before, after = _robot(group, seen.mount)
    possible = [
        [pose.matrix for pose in board_poses(view, camera, refine=False)] for view in group.views
    ]
    if not group.through_robot:
        best = np.stack([poses[0] for poses in possible])
        return Located(group, best, np.eye(4), before, after, sheet)
    chain = zip(before, after, possible, strict=True)
    on_mount = [[invert(b @ f) @ camera_pose @ T for T in poses] for b, f, poses in chain]
    board_pose = _middle_pose(on_mount)
    nearest = [int(np.argmin(_apart(board_pose, np.stack(poses)))) for poses in on_mount]
    in_camera = np.stack([poses[i] for poses, i in zip(possible, nearest, strict=True)])
    return Located(group, in_camera, board_pose, before, after, sheet)


def _robot(group: BoardViews, mount: Mount) -> tuple[Array, Array]:
    """B and F (n, 4, 4) of the chain."""
    ones = np.broadcast_to(np.eye(4), (len(group.views), 4, 4))
    if not group.through_robot:
        return ones, ones
    flange = np.stack([v.T_base_flange.matrix for v in group.views if isinstance(v, RobotView)])
    return (flange, ones) if mount == "eye-to-hand" else (ones, invert(flange))


def _middle_pose(options: Sequence[Sequence[Array]]) -> Array:
    """The one of all poses that is nearest to the nearest of each view's."""
    every = np.concatenate([np.stack(poses) for poses in options])
    total = sum(_apart(every[:, None], np.stack(poses)).min(axis=1) for poses in options)
    return np.asarray(every[int(np.argmin(total))])


def _apart(one: Array, other: Array) -> Array:
    """Metres, a radian counting as one: the distance (...) of poses (..., 4, 4)."""
    off = one - other
    turned = np.sqrt(np.square(off[..., :3, :3]).sum(axis=(-2, -1)) / 2.0)
    return np.asarray(np.linalg.norm(off[..., :3, 3], axis=-1) + turned)


def _lens_prior(projector: ProjectorMap) -> LensPrior | None:
    if projector.focal_px == 1.0:  # a homography alone
        return None
    return LensPrior(projector.centre, projector.focal_px)


def _area(seen: Observations, start: Calibration) -> Area:
    """What was drawn in, or lit, and a margin."""
    xy = seen.circles.xy
    if len(xy) < 2:
        xy = start.locate(seen.markers.projector_px)[:, :2]
    if len(xy) < 2:
        xy = np.asarray(seen.touches)[:, :2]
    if len(xy) < 2:
        raise BadInput(
            "the joint adjustment: no circles, lit points or touches say where it counts"
        )
    middle, half = (xy.max(axis=0) + xy.min(axis=0)) / 2, np.ptp(xy, axis=0) / 2
    return Area(middle - MARGIN * half, middle + MARGIN * half)


def _layout(
    seen: Observations,
    state: JointState,
    located: Sequence[Located],
    options: JointOptions,
    lens: LensPrior | None,
) -> Layout:
    tied = [one.group.board for one in located if one.group.through_robot]
    on_table = bool(len(seen.circles)) or isinstance(state.projector, FullProjector)
    sizes = {"camera": 9 * options.camera, "pose": 6 * (bool(tied) or on_table)}
    for board in state.boards:
        sizes[f"{board} pose"] = 6 * (board in tied)
        sizes[f"{board} scale"] = 1 * (options.scale and board in tied)
        sizes[f"{board} warp"] = 3 * options.warp
    sizes["table"] = TERMS[options.table] * (on_table or bool(len(seen.touches)))
    sizes["level"] = 3 * bool(len(seen.touches))
    if len(seen.markers) or seen.lit_boards:
        full = isinstance(state.projector, FullProjector)
        sizes["projector"] = 11 if full else 8 if lens is None else 12
        sizes["bend"] = state.bend.size
    if len(seen.circles):
        sizes |= {"tcp": 2, "field": state.field.size}
        sizes["robot"] = 6 * (bool(tied) and seen.mount == "eye-to-hand")
    sizes["look"] = 6 * (seen.look is not None and on_table)
    return Layout({name: size for name, size in sizes.items() if size})


def _groups(
    layout: Layout, located: Sequence[Located], options: JointOptions
) -> tuple[ViewGroup, ...]:
    groups, place = [], 0
    for one in located:
        board, tied = one.group.board, one.group.through_robot
        names = ["camera", "pose", f"{board} pose", f"{board} scale", f"{board} warp"]
        names = [n for n in names if n in layout and (tied or n in ("camera", f"{board} warp"))]
        end = place + len(one.group.views)
        ids = tuple(view.id for view in one.group.views)
        groups.append(
            ViewGroup(
                name=one.group.name,
                board=board,
                chain=one.chain(options),
                views=slice(place, end),
                columns=layout.columns(names),
                ids=ids,
                free_pose=not tied,
            )
        )
        place = end
    return tuple(groups)


def _mm(state: JointState, look: Array, seen: Observations) -> Array:
    """(n, 2, 2) millimetres on the table by a camera pixel at the circles."""
    circles = seen.circles
    picture = pen(state, look, None, circles.xy, rotations(circles.yaw))
    if not np.isfinite(picture.xy).all():
        raise SolveError("circles lie behind the camera: its pose is wrong")
    flat = np.column_stack([picture.xy, np.ones(len(circles))])
    _, by_point, _ = state.camera.jacobians(flat, intrinsics=False)
    return 1e3 * np.linalg.inv(by_point[..., :2] @ picture.slopes["place"])


def _field(state: JointState, look: Array, length: float) -> Field:
    low, high = state.table.area.low, state.table.area.high
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, GRID)] * 2), axis=-1).reshape(-1, 2)
    xy = (low + high) / 2 + steps * (high - low) / 2
    picture = pen(state, look, None, xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2)))
    least, most = picture.xy.min(axis=0), picture.xy.max(axis=0)
    scale = float((most - least).max()) / 2
    mm = 1e3 * scale / float(np.sqrt(np.abs(np.linalg.det(picture.slopes["place"])).mean()))
    reach = FIELD_REACH * (most - least) / (2 * scale)
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, FIELD_NODES)] * 2), axis=-1)
    nodes = steps.reshape(-1, 2) * reach
    values, vectors = np.linalg.eigh(kernel_values("rbf", length, nodes, nodes))
    kept = values > NEGLIGIBLE_MODE * values[-1]
    modes = vectors[:, kept] / np.sqrt(values[kept])
    return Field((least + most) / 2, scale, mm, length, nodes, modes)


def _full_projector(
    seen: Observations,
    state: JointState,
    located: Sequence[Located],
    look: Array,
    lens: LensPrior | None,
) -> FullProjector:
    """From where light landed, on the table and on boards, as the camera saw it."""
    groups = {one.group.name: one for one in located}
    T = world_camera(state, look)
    rays = _rays(state.camera, seen.markers.camera_px) @ T[:3, :3].T
    points, pixels = [state.table.hit(T[:3, 3], rays)], [seen.markers.projector_px]
    for lit in seen.lit_boards:
        group = groups.get(lit.group)
        ids = [] if group is None else [view.id for view in group.group.views]
        if group is None or lit.view not in ids:
            raise BadInput(f"light was seen on the board of {lit.view!r}, which is no view")
        i = ids.index(lit.view)
        frame = group.in_camera[i]
        rays = _rays(state.camera, lit.light.camera_px)
        on_board = rays * ((frame[:3, 3] @ frame[:3, 2]) / (rays @ frame[:3, 2]))[:, None]
        flange = np.eye(4) if seen.mount == "eye-to-hand" else invert(group.after[i])
        points.append(transform_points(flange @ state.camera_pose, on_board))
        pixels.append(lit.light.projector_px)
    return resection(np.concatenate(points), np.concatenate(pixels), lens)


def _rays(camera: CameraModel, pixels: Array) -> Array:
    xy = camera.normalise(pixels)
    return np.column_stack([xy, np.ones(len(xy))])
