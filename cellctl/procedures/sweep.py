"""A sweep: find a board with the camera, plan views of it, show them one after the other.

Everything that decides what comes next is journalled before the arm moves: the choice of each
search view, the plan, each picture with its pose. So a run that was cut short goes on with the
next picture and ends as it would have ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cellctl.arms import JOINTS
from cellctl.calib.printed import Unseen
from cellctl.calib.targets import Board
from cellctl.calib.views import RobotView
from cellctl.cell import Cell
from cellctl.drivers.base import Path, RobotState, Target
from cellctl.errors import MotionRefused, SolveError
from cellctl.geometry import Array
from cellctl.motion import Guard
from cellctl.procedures.belief import Belief
from cellctl.procedures.capture import CaptureLimits, Shot, darken, shoot
from cellctl.procedures.observations import journalled, observation
from cellctl.procedures.planning import (
    SEARCH_CHOICES,
    Spread,
    first_reached,
    plan_sweep,
    reach,
    retrace,
    search_views,
)
from cellctl.procedures.rig import PlannedView
from cellctl.run import Run
from cellctl.store.history import Sample

SEARCH_ATTEMPTS, SEARCH_SEEDS = 4, 1000
SEARCH_EDGE = 0.05
"""Share of the picture's width that a board keeps from its border while little is known."""
MOVE_TIMEOUT_S = 120.0
SEARCH, PLAN, VIEWS = "search", "plan", "views"


@dataclass(frozen=True, eq=False)
class Sweep:
    """What to show: `count` good views of `board`, looked for in `search` poses at most."""

    board: Board
    count: int
    spread: Spread
    limits: CaptureLimits
    search: int
    seed: int


async def collect(run: Run, cell: Cell, sweep: Sweep, belief: Belief) -> Belief:
    """Search, plan and show; samples are in the run. Returns what is believed in the end.

    Raises SolveError when the board was never found or no view of it can be shown.
    """
    await darken(cell)
    belief = await search(run, cell, sweep, belief)
    plan = await _plan(run, cell, sweep, belief)
    await show(run, cell, sweep, plan)
    return belief


async def search(run: Run, cell: Cell, sweep: Sweep, belief: Belief) -> Belief:
    """Show the board until it was seen from a few sides, and believe what was seen."""
    await run.step(SEARCH, belief.enough_views)
    for i in range(sweep.search):
        found = _found(run, sweep.board)
        run.progress(len(found), f"looking for the board ({i + 1})")
        if len(found) >= belief.enough_views:
            break
        key = f"look-{i:02}"
        if key not in run.samples():
            way = await _choice(run, cell, sweep, belief, i)
            await _look(run, cell, sweep, key, way, way)
    if not found:
        raise SolveError(
            f"the board was not found in {len(run.samples())} poses: is it mounted as the config "
            "says, is it lit, are the tape-measured poses within [tape]?"
        )
    return await run.call(belief.updated, found)


async def _choice(run: Run, cell: Cell, sweep: Sweep, belief: Belief, i: int) -> Array:
    """The way (n, 6) to the next search view; recalled when it was journalled before a crash."""
    chosen = next((r for r in run.records("choice") if r["index"] == i), None)
    if chosen is None:
        here = await posture(run, cell)
        found = await run.call(
            next_search,
            cell.guard,
            belief,
            sweep.board,
            _found(run, sweep.board),
            _visited(run.samples()),
            here,
            i,
        )
        if found is None:
            raise SolveError("no view of the board is allowed where the config says it can be seen")
        view, path = found
        chosen = {"index": i, **_view_data(view), "way": path.waypoints.tolist()}
        await run.record("choice", **chosen)
    return np.array(chosen["way"])


def _found(run: Run, board: Board) -> list[RobotView]:
    """The views of a search in which the board was seen, and stood still."""
    still = [sample for sample in run.samples().values() if sample.data["still"]]
    views = [journalled(sample, board) for sample in still]
    return [view for view in views if not isinstance(view, Unseen)]


def _visited(samples: Mapping[str, Sample]) -> Array:
    """The postures (n, 6) that a search has been in."""
    return np.array([s.data["way"][-1] for s in samples.values()]).reshape(-1, JOINTS)


def gone(run: Run) -> Array:
    """Corners (n, 6) of all that the arm has gone along in this run, oldest first."""
    steps = run.all_samples().values()
    ways = [s.data["way"] for step in steps for s in step.values() if "way" in s.data]
    return np.array([corner for way in ways for corner in way]).reshape(-1, JOINTS)


async def posture(run: Run, cell: Cell) -> Array:
    """Where plans start, joints (6,): the posture that this run has sent the arm to last, or where
    it stands. A resumed run, whose arm may stand somewhere else, plans as it would have."""
    corners = gone(run)
    return corners[-1] if len(corners) else (await cell.robot.read()).joints


def next_search(
    guard: Guard,
    belief: Belief,
    board: Board,
    found: list[RobotView],
    visited: Array,
    here: Array,
    step: int,
) -> tuple[PlannedView, Path] | None:
    """Pure: the best search view that can be reached from `here`, and the path to it. `visited`
    (n, 6) are postures in which the arm has been."""
    guard = guard.cautious(here)
    believed = belief.updated(found)
    rig = believed.rig(board)
    had = np.array([believed.seen(view) for view in found]).reshape(-1, 4, 4)
    edge = SEARCH_EDGE * rig.camera.image_size[0]
    for attempt in range(SEARCH_ATTEMPTS):
        seed = step + SEARCH_SEEDS * attempt
        views = search_views(rig, guard, here, step, had, edge, seed)
        reached = first_reached(guard, here, views[:SEARCH_CHOICES], visited)
        if reached is not None:
            return reached
    return None


async def _plan(run: Run, cell: Cell, sweep: Sweep, belief: Belief) -> list[PlannedView]:
    recorded = run.recall(PLAN)
    if recorded is None:
        run.progress(0, "planning views")
        here = await posture(run, cell)
        rig = belief.rig(sweep.board)
        views = await run.call(
            plan_sweep, rig, cell.guard, here, sweep.spread, sweep.count, sweep.seed
        )
        recorded = {"views": [_view_data(view) for view in views]}
        await run.record(PLAN, **recorded)
    if not recorded["views"]:
        raise SolveError(
            "no view of the board is reachable, allowed and in the picture; draw it with "
            "`cellctl plan` and move keep-outs, camera or bracket"
        )
    return [_view_of(data) for data in recorded["views"]]


async def show(run: Run, cell: Cell, sweep: Sweep, plan: list[PlannedView]) -> None:
    """Show planned views until enough are good; the spares behind them replace bad ones."""
    await run.step(VIEWS, sweep.count)
    hubs = np.array([view.joints for view in plan])
    for i, view in enumerate(plan):
        good = sum(not sample.data["flaw"] for sample in run.samples().values())
        run.progress(good, f"view {i + 1}")
        if good >= sweep.count:
            break
        key = f"view-{i:03}"
        if key not in run.samples():
            await _look_if_reached(run, cell, sweep, key, view.joints[None], hubs)


async def _look_if_reached(
    run: Run, cell: Cell, sweep: Sweep, key: str, way: Array, hubs: Array
) -> None:
    """As `_look`; a view that cannot be reached from here is journalled and passed over."""
    try:
        await _look(run, cell, sweep, key, way, hubs)
    except MotionRefused as refused:
        await run.sample(key, {"flaw": refused.message, "still": False, **observation(None)})


async def _look(run: Run, cell: Cell, sweep: Sweep, key: str, way: Array, hubs: Array) -> None:
    """Go to the end of `way` (n, 6), take a picture there, journal both."""
    await run.checkpoint(f"the arm moves to {key}")
    async with run.taking(key):
        state, taken = await go(run, cell, way, hubs)
        shot = await shoot(cell, sweep.board, state.t, sweep.limits)
    await run.sample(key, sample_data(shot, taken), {"image": shot.image})


def sample_data(shot: Shot, way: Path) -> dict[str, Any]:
    """What is journalled of a picture of a board: the way there, pose, corners, and what is wrong
    with it."""
    return {
        "flaw": shot.flaw,
        "still": shot.still,
        "joints": shot.state.joints.tolist(),
        "way": way.waypoints.tolist(),
        "T_world_flange": shot.state.T_world_flange.to_list(),
        "pictures": shot.pictures,
        "t": shot.state.t,
        **observation(shot.detection),
    }


async def go(run: Run, cell: Cell, way: Array, hubs: Array) -> tuple[RobotState, Path]:
    """Move to the end of `way` (n, 6) over an allowed path, if need be by way of `hubs` (m, 6) or
    back where the arm came from; the settled state and that path. MotionRefused without one."""
    here = (await cell.robot.read()).joints
    path: Path | None = await run.call(reach, cell.guard, here, way, hubs)
    if path is None:
        path = await run.call(retrace, cell.guard, here, way[-1], gone(run))
    if path is None:
        degrees = ", ".join(f"{v:.1f}" for v in np.degrees(way[-1]))
        raise MotionRefused(f"no allowed path leads to joints {degrees} deg; nothing has moved")
    timeout_s = MOVE_TIMEOUT_S / run.speed
    return await cell.robot.move(Target(path, run.speed), timeout_s=timeout_s), path


def _view_data(view: PlannedView) -> dict[str, Any]:
    return {"joints": view.joints.tolist(), "T_camera_board": view.T_camera_board.tolist()}


def _view_of(data: dict[str, Any]) -> PlannedView:
    return PlannedView(np.array(data["T_camera_board"]), np.array(data["joints"]))
