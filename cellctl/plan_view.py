"""`cellctl plan`: what a procedure would do, drawn from the config alone. Moves nothing.

Poses are planned as if the tape-measured poses were right; the run plans again from what it sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from cellctl.arms import JOINTS
from cellctl.config import CellConfig
from cellctl.drivers.base import Image
from cellctl.errors import BadInput, MotionRefused
from cellctl.geometry import Array
from cellctl.ik import random_starts
from cellctl.motion import Guard, guard_of
from cellctl.procedures import hand_eye, intrinsic, parking, planning, projector
from cellctl.procedures.knowledge import known
from cellctl.procedures.rig import PlannedView, Rig
from cellctl.procedures.sweep import Sweep

PLANES = {"top (x, y)": (0, 1), "front (x, z)": (0, 2), "side (y, z)": (1, 2)}


@dataclass(frozen=True, eq=False)
class Planned:
    """One part of a procedure: `path` (n, 6) joints as checked; `views` with their rig, or a first
    `picture` that the projector shows."""

    title: str
    path: Array
    views: list[PlannedView]
    rig: Rig | None
    picture: Image | None = None


def plan(config: CellConfig, procedure: str) -> list[Planned]:
    """Plan `procedure`'s parts one after the other. BadInput for an unknown procedure,
    MotionRefused when nothing can be planned; both say why."""
    guard = guard_of(config)
    here = _somewhere_free(guard)
    parts = []
    for name in _parts(procedure):
        part = (
            _park(config, guard, here) if name == "projector" else _sweep(config, guard, here, name)
        )
        parts.append(part)
        here = part.path[-1]
    return parts


def _parts(procedure: str) -> tuple[str, ...]:
    parts = {
        "intrinsic": ("intrinsic",),
        "hand-eye": ("hand-eye",),
        "projector": ("projector",),
        "full": ("intrinsic", "hand-eye", "projector"),
    }
    if procedure not in parts:
        raise BadInput(f"no plan for {procedure!r}; there are: {', '.join(parts)}")
    return parts[procedure]


def _somewhere_free(guard: Guard) -> Array:
    drawn = random_starts(guard.arm, 2000, seed=1)
    free = drawn[guard.free(drawn)]
    if not len(free):
        raise MotionRefused("the guard allows no posture of the arm at all: check [workspace]")
    return free[np.argmin(np.abs(free - free.mean(axis=0)).max(axis=1))]


def _sweep(config: CellConfig, guard: Guard, here: Array, name: str) -> Planned:
    sweep: Sweep
    if name == "intrinsic":
        board, sweep = intrinsic.BOARD, intrinsic.sweep_of(config, intrinsic.IntrinsicParams())
    else:
        board, sweep = hand_eye.BOARD, hand_eye.sweep_of(config, hand_eye.HandEyeParams())
    rig = known(config, None).belief(config, board).rig(sweep.board)
    views = planning.plan_sweep(rig, guard, here, sweep.spread, sweep.count, sweep.seed)
    if not views:
        raise MotionRefused(
            f"{name}: no view of the board is reachable, allowed and in the picture; move the "
            "camera, the bracket or the keep-outs"
        )
    route, reached = _route(guard, here, views, sweep.count)
    return Planned(name, route, reached, rig)


def _route(
    guard: Guard, here: Array, views: list[PlannedView], count: int
) -> tuple[Array, list[PlannedView]]:
    """The path over `count` views, and those views; as in a run, spares replace those that no
    path leads to."""
    hubs = np.array([view.joints for view in views])
    pieces = [here[None]]
    reached: list[PlannedView] = []
    for view in views:
        path = planning.reach(guard, pieces[-1][-1], view.joints[None], hubs)
        if path is not None and len(reached) < count:
            pieces.append(guard.sample(pieces[-1][-1], path))
            reached.append(view)
    return np.vstack(pieces), reached


def _park(config: CellConfig, guard: Guard, here: Array) -> Planned:
    beams = parking.beams(config, known(config, None).T_world_camera)
    margin = parking.MARGIN_M + config.tape.position_m
    path = parking.way_out(guard, beams, here, np.empty((0, JOINTS)), margin, 0)
    if path is None:
        raise MotionRefused("projector: no allowed posture leaves the light free")
    pictures = projector.pictures_of(config, projector.ProjectorParams())
    title = f"projector ({len(pictures)} pictures)"
    return Planned(title, guard.sample(here, path), [], None, pictures[0].image)


def draw_plan(procedure: str, config: CellConfig, output: FilePath) -> dict[str, Any]:
    """Draw the plan into `output` (PNG, PDF or SVG by its suffix); a summary of it, as JSON."""
    parts = plan(config, procedure)
    guard = guard_of(config)
    figure = Figure(figsize=(20, 4.6 * len(parts)), layout="constrained")
    axes = figure.subplots(len(parts), len(PLANES) + 1, squeeze=False)
    for row, part in zip(axes, parts, strict=True):
        for axis, (title, plane) in zip(row, PLANES.items(), strict=False):
            _draw_space(axis, config, guard, part, plane)
            axis.set_title(f"{part.title}: {title}, metres")
        if part.picture is None:
            _draw_views(row[-1], config, part)
        else:
            row[-1].imshow(part.picture, cmap="gray")
            row[-1].set_title(f"{part.title}: the first one, projector px")
    try:
        figure.savefig(output, dpi=80)
    except (OSError, ValueError) as error:
        raise BadInput(f"{output}: the plan cannot be written: {error}") from None
    return {
        "procedure": procedure,
        "picture": str(output),
        "parts": [
            {"name": part.title, "views": len(part.views), "checked_states": len(part.path)}
            for part in parts
        ],
    }


def _draw_space(
    axis: Axes, config: CellConfig, guard: Guard, part: Planned, plane: tuple[int, int]
) -> None:
    scene = guard.scene
    _box(axis, scene.box_low, scene.box_high, plane, fill=False, edgecolor="0.4", linestyle="--")
    for keepout in scene.keepouts:
        _box(axis, keepout.low, keepout.high, plane, facecolor="tab:red", alpha=0.3)
        axis.annotate(keepout.name, (keepout.low[plane[0]], keepout.high[plane[1]]), fontsize=7)
    for name, centre, radius in scene.balls:
        place = (centre[plane[0]], centre[plane[1]])
        axis.add_patch(Circle(place, radius, color="tab:orange", alpha=0.3))
        axis.annotate(name, place, ha="center", fontsize=8)
    lit = parking.lit_area(config)
    axis.add_patch(Polygon(lit[:, plane], facecolor="gold", alpha=0.4, edgecolor="goldenrod"))
    flange = guard.arm.forward(part.path)[:, :3, 3]
    axis.plot(flange[:, plane[0]], flange[:, plane[1]], linewidth=0.8, color="tab:blue")
    _draw_arm(axis, guard, part.path[-1], plane)
    for view in part.views:
        corners = _corners(part, view)
        axis.plot(corners[:, plane[0]], corners[:, plane[1]], linewidth=0.7, color="tab:green")
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.grid(visible=True, linewidth=0.3)


def _box(axis: Axes, low: Array, high: Array, plane: tuple[int, int], **style: Any) -> None:
    a, b = plane
    axis.add_patch(Rectangle((low[a], low[b]), high[a] - low[a], high[b] - low[b], **style))


def _draw_arm(axis: Axes, guard: Guard, joints: Array, plane: tuple[int, int]) -> None:
    centres, radii = guard.spheres(joints, list(guard.bodies))
    for centre, radius in zip(centres[0], radii, strict=True):
        axis.add_patch(Circle((centre[plane[0]], centre[plane[1]]), radius, color="0.5", alpha=0.2))


def _corners(part: Planned, view: PlannedView) -> Array:
    """The board's outline (5, 3) in the world, closed."""
    assert part.rig is not None
    corners = part.rig.board_points(view.T_camera_board[None])[0][[0, 1, 3, 2, 0]]
    pose = part.rig.T_world_camera
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _draw_views(axis: Axes, config: CellConfig, part: Planned) -> None:
    width, height = config.camera.image_size_px
    axis.add_patch(Rectangle((0, 0), width, height, fill=False))
    for number, view in enumerate(part.views, 1):
        assert part.rig is not None
        corners = part.rig.board_points(view.T_camera_board[None])[0][[0, 1, 3, 2]]
        pixels = part.rig.camera.project(corners)
        axis.add_patch(Polygon(pixels, fill=False, edgecolor="tab:green", linewidth=0.8))
        x, y = pixels.mean(axis=0)
        axis.annotate(str(number), (x, y), ha="center", fontsize=7)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_aspect("equal")
    axis.set_title(f"{part.title}: in the camera's picture, px")
