"""Out of the light: the arm is moved to where neither camera nor projector sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.drivers.base import Path
from cellctl.errors import MotionRefused
from cellctl.geometry import Array, Transform
from cellctl.ik import random_starts
from cellctl.motion import Guard
from cellctl.procedures.moving import go, gone, posture
from cellctl.procedures.routing import Roadmap, shortened
from cellctl.run import Run

MARGIN_M = 0.05
CANDIDATES, TRIES, BRIDGES = 3000, 60, 4
PARK, PARKED = "park", "parked"


@dataclass(frozen=True, eq=False)
class Beam:
    """What must stay free for a device: the pyramid from `apex` (3,) over `base` (4, 3)."""

    apex: Array
    base: Array

    def clearance(self, centres: Array, radii: Array) -> Array:
        """How far the nearest of spheres (n, m, 3) is outside (n,), metres; negative: inside."""
        edges = self.base - self.apex
        normals = np.cross(edges, np.roll(edges, -1, axis=0))
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        if normals[0] @ (self.base.mean(axis=0) - self.apex) > 0:
            normals = -normals
        outside = (centres - self.apex) @ normals.T
        return (outside.max(axis=2) - radii).min(axis=1)


def way_out(
    guard: Guard, beams: list[Beam], here: Array, visited: Array, margin: float, seed: int
) -> Path | None:
    """Pure: a path to a posture that leaves `margin` metres around all beams, a near one.

    Postures are drawn at random; where none keeps the margin, those that come nearest to it are
    taken. If none of them can be reached the arm goes back the way it came, over the postures
    `visited` (n, 6), oldest first. None when that does not lead out of the beams either.
    """
    drawn = np.vstack([here, random_starts(guard.arm, CANDIDATES, seed)])
    return _drawn(guard.cautious(here), beams, here, drawn, margin) or _back(
        guard, beams, here, visited
    )


def _drawn(
    guard: Guard, beams: list[Beam], here: Array, drawn: Array, margin: float
) -> Path | None:
    """To the first that can be reached of the postures `drawn` (n, 6), nearest first."""
    drawn = drawn[guard.free(drawn)]
    clear = clearance(guard, beams, drawn)
    if not len(drawn) or clear.max() <= 0.0:
        return None
    parked = drawn[clear >= min(margin, float(np.sort(clear)[-20:].min()))]
    if np.array_equal(parked[0], here):
        return Path(here[None])
    near = np.argsort(np.abs(parked - here).max(axis=1), kind="stable")[:TRIES]
    hubs = drawn[np.argsort(np.abs(drawn - here).max(axis=1), kind="stable")[: 2 * TRIES]]
    road = Roadmap(guard, here, np.vstack([parked[near], hubs]))
    for _ in range(BRIDGES):
        reached = [i for i in sorted(road.index) if i < len(near)]
        if reached:
            return road.path(here, road.index[reached[0]])
        if not road.bridge():
            return None
    return None


def _back(guard: Guard, beams: list[Beam], here: Array, visited: Array) -> Path | None:
    """Back over `visited`, from where it can be joined, to the last posture that was clear."""
    clear = clearance(guard, beams, visited) > 0.0
    for joined in np.argsort(np.abs(visited - here).max(axis=1), kind="stable"):
        outside = np.flatnonzero(clear[: joined + 1])
        if not len(outside):
            continue
        back = Path(visited[outside[-1] : joined + 1][::-1])
        if guard.allows(here, back):
            corners = np.vstack([here, back.waypoints])
            return Path(shortened(guard, corners, seed=0)[1:])
    return None


def clearance(guard: Guard, beams: list[Beam], joints: Array) -> Array:
    """How far (n,) the arm at joints (n, 6) stays outside all beams, metres."""
    if not len(joints):
        return np.zeros(0)
    centres, radii = guard.spheres(joints)
    return np.min([beam.clearance(centres, radii) for beam in beams], axis=0)


def beams(config: CellConfig, T_world_camera: Transform) -> list[Beam]:
    """What camera and projector need free to see and light the table's lit area."""
    base = lit_area(config)
    apexes = (T_world_camera.translation, np.array(config.projector.pose.position_m))
    return [Beam(apex, base) for apex in apexes]


def lit_area(config: CellConfig) -> Array:
    """Corners (4, 3) of the lit area in the world frame, from tape, throw ratio and picture."""
    pose = config.table.pose.transform("world", "table")
    distance = config.projector.pose.position_m[2] - config.table.touched_height_m
    width = distance / config.projector.throw_ratio
    height = width * config.projector.size_px[1] / config.projector.size_px[0]
    half = np.array([width, height, 0.0]) / 2
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * half
    return pose.apply(corners)


async def park_again(run: Run, cell: Cell, T_world_camera: Transform, key: str) -> None:
    """As `park`, but to the posture that this part of the run has parked in before, if it has and
    a path leads there."""
    before = run.records(PARKED)
    if not before or any(r["key"] == key for r in before):
        await park(run, cell, T_world_camera, key)
        return
    await run.step(PARK)
    if key in run.samples():
        return
    way = np.array(before[0]["way"])
    await run.checkpoint("the arm moves out of the light")
    try:
        async with run.taking(key):
            _, taken = await go(run, cell, way[-1:], np.vstack([way, gone(run)]))
    except MotionRefused:
        await park(run, cell, T_world_camera, key)
        return
    await run.sample(key, {"way": taken.waypoints.tolist()})


async def park(run: Run, cell: Cell, T_world_camera: Transform, key: str) -> None:
    """Leave the beams free; `key` names this time among others of the same run. MotionRefused
    when no allowed posture does."""
    await run.step(PARK)
    recorded = next((r for r in run.records(PARKED) if r["key"] == key), None)
    if recorded is None:
        here = await posture(run, cell)
        margin = MARGIN_M + cell.config.tape.position_m
        light = beams(cell.config, T_world_camera)
        path: Path | None = await run.call(way_out, cell.guard, light, here, gone(run), margin, 0)
        if path is None:
            raise MotionRefused(
                "no allowed posture leaves the light free: widen the workspace box, or move "
                "camera or projector"
            )
        recorded = {"key": key, "way": path.waypoints.tolist()}
        await run.record(PARKED, **recorded)
    way = np.array(recorded["way"])
    await run.checkpoint("the arm moves out of the light")
    async with run.taking(key):
        await go(run, cell, way, way)
    if key not in run.samples():
        await run.sample(key, {"way": recorded["way"]})
