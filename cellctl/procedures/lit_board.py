"""A second plane: the marker board, held into the projector's light at several heights.

The board's own markers, seen before the light goes on, tell where it is; a Gray code without
inverses, which its print does not disturb, tells which of the projector's pixels lights what.
What was read is journalled as plain arrays.
"""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np

from cellctl.calib.corners import grey
from cellctl.calib.graycode import BLACK, WHITE, GrayCode
from cellctl.calib.graycode_decode import LEAST_CONTRAST, decode
from cellctl.calib.graycode_local import at_places
from cellctl.calib.projector_map import apply_homography, direct_linear_transform
from cellctl.calib.second_plane import LitPlane
from cellctl.calib.targets import Board
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.drivers.base import Image
from cellctl.errors import MotionRefused, SolveError
from cellctl.geometry import Array, Transform, invert
from cellctl.procedures.belief import Belief
from cellctl.procedures.capture import CaptureLimits, darken, grab_still, mean_image, shoot
from cellctl.procedures.knowledge import board_of
from cellctl.procedures.light_code import FRAMES, code_of
from cellctl.procedures.moving import go, posture
from cellctl.procedures.observations import observation
from cellctl.procedures.planning import Spread, plan_sweep
from cellctl.procedures.record import Record
from cellctl.procedures.sweep import sample_data
from cellctl.run import Run
from cellctl.store.history import Sample

BOARD = "markers"
PLAN, LIT, SLIDES = "lit-plan", "lit", "lit-slides"
SPREAD = Spread(tilt_deg=(0.0, 30.0), spin_deg=60.0, fill=(0.14, 0.24), middle=0.3)
"""Near the middle of the picture, where the light is; between the table and half-way up."""
LIT_SHARE = 0.5
"""Part of the board's points that must be in the light."""
STEP = 0.04
"""Between places that are read, in the board's longer sides."""
READ_TIMEOUT_S = 120.0


def held_code(config: CellConfig, stripe_px: int) -> GrayCode:
    """White and black first: they tell whether the board is in the light at all."""
    table = code_of(config, stripe_px)
    return GrayCode.of(
        table.size,
        order=("white", "black", "columns", "rows"),
        column_bits=len(table.bits("column")),
        row_bits=len(table.bits("row")),
        inverses=False,
    )


async def collect(run: Run, cell: Cell, belief: Belief, count: int, stripe_px: int) -> None:
    """Show the board in the light until it was read `count` times; then dark again. SolveError
    when no place in the light can be reached."""
    board = board_of(cell.config, BOARD)
    await darken(cell)
    plan = await _plan(run, cell, belief, board, count)
    for i, joints in enumerate(plan):
        await run.step(LIT, count)
        good = sum(not sample.data["flaw"] for sample in run.samples().values())
        run.progress(good)
        if good >= count:
            break
        key = f"board-{i:02d}"
        if key not in run.samples():
            await _light(run, cell, board, key, joints, np.array(plan), stripe_px)
    await darken(cell)


async def _plan(run: Run, cell: Cell, belief: Belief, board: Board, count: int) -> list[Array]:
    recorded = run.recall(PLAN)
    if recorded is None:
        here = await posture(run, cell)
        views = await run.call(
            plan_sweep, belief.rig(board), cell.guard, here, SPREAD, max(2 * count, 4), 0
        )
        recorded = {"joints": [view.joints.tolist() for view in views]}
        await run.record(PLAN, **recorded)
    if not recorded["joints"]:
        raise SolveError("the marker board cannot be held into the light: no pose is allowed")
    return [np.array(joints) for joints in recorded["joints"]]


async def _light(
    run: Run, cell: Cell, board: Board, key: str, joints: Array, hubs: Array, stripe_px: int
) -> None:
    """Hold the board there, look at it in the dark, show the code on it, journal what was read."""
    await run.checkpoint(f"the arm moves to {key}")
    try:
        async with run.taking(key):
            state, taken = await go(run, cell, joints[None], hubs)
            shot = await shoot(cell, board, state.t, CaptureLimits())
    except MotionRefused as refused:
        await run.sample(key, {"flaw": refused.message, "still": False, **observation(None)})
        return
    data, slides = sample_data(shot, taken), dict[str, Sample]()
    if not shot.flaw:
        code = held_code(cell.config, stripe_px)
        data["flaw"], slides = await _show(run, cell, key, code, np.array(data["pixels"]))
        if not data["flaw"]:
            corners = np.array(data["points"]), np.array(data["pixels"])
            read = await run.call(
                read_board, slides, key, code, board, *corners, timeout_s=READ_TIMEOUT_S
            )
            data |= read
    await run.step(LIT)
    await darken(cell)
    await run.sample(key, data, {"image": shot.image})


async def _show(
    run: Run, cell: Cell, key: str, code: GrayCode, corners: Array
) -> tuple[str, dict[str, Sample]]:
    """All slides, recorded; or after the first two what is wrong: the board is not in the light."""
    await run.step(SLIDES, len(code.slides))
    for i, slide in enumerate(code.slides):
        name = slide_name(key, i)
        if name not in run.samples():
            async with run.taking(name):
                on_glass = await cell.projector.show(code.picture(slide))
                frames = await grab_still(cell, on_glass, FRAMES)
                image = await asyncio.to_thread(mean_image, frames)
            await run.sample(name, {}, {"image": image})
        if slide == BLACK:
            white = run.samples()[slide_name(key, code.index(WHITE))].images["image"]
            black = run.samples()[name].images["image"]
            share = lit_share(
                await asyncio.to_thread(white.load), await asyncio.to_thread(black.load), corners
            )
            if share < LIT_SHARE:
                return f"only {share:.0%} of the board is in the light", {}
    return "", dict(run.samples())


def lit_share(white: Image, black: Image, corners: Array) -> float:
    """Part of the corners (n, 2) about which the white picture is brighter than the black one."""
    bright = grey(white).astype(int) - grey(black) >= LEAST_CONTRAST
    column, row = np.rint(corners).astype(int).T
    near = [
        bright[
            np.clip(row + dy, 0, bright.shape[0] - 1), np.clip(column + dx, 0, bright.shape[1] - 1)
        ]
        for dx in (-4, 0, 4)
        for dy in (-4, 0, 4)
    ]
    return float(np.any(near, axis=0).mean())


def slide_name(key: str, index: int) -> str:
    return f"{key}-slide-{index:02d}"


def read_board(
    slides: dict[str, Sample], key: str, code: GrayCode, board: Board, points: Array, pixels: Array
) -> dict[str, Any]:
    """Pure: `projector_px` and `camera_px`, lists of [x, y], of a lattice of places on the board,
    and a `flaw` when hardly any could be read. `points` (n, 3) and `pixels` (n, 2) are corners of
    the board."""
    low, high = board.extent()
    step = STEP * float((high - low).max())
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    H = direct_linear_transform(points[:, :2], pixels)
    places = apply_homography(H, lattice)
    reach = 1.5 * float(np.linalg.norm(np.diff(places[:2], axis=0)))
    images = [
        grey(slides[slide_name(key, i)].images["image"].load()) for i in range(len(code.slides))
    ]
    shape = np.array(images[0].shape[::-1])
    first = np.floor(np.maximum(places.min(axis=0) - reach - 4, 0)).astype(int)
    last = np.ceil(np.minimum(places.max(axis=0) + reach + 5, shape)).astype(int)
    part = [image[first[1] : last[1], first[0] : last[0]] for image in images]
    try:
        local = at_places(decode(part, code), places - first, np.full(len(places), reach))
    except SolveError as error:
        return {"flaw": error.message, "projector_px": [], "camera_px": []}
    good = local.found
    flaw = "" if good.mean() >= LIT_SHARE / 2 else f"only {good.mean():.0%} of the light was read"
    return {
        "flaw": flaw,
        "projector_px": np.round(local.pixels[good], 3).tolist(),
        "camera_px": np.round(places[good], 3).tolist(),
    }


def seen(
    record: Record[Any], T_world_camera: Transform, T_flange_board: Transform
) -> list[LitPlane]:
    """What was read on the held boards, which are where the robot says that they were."""
    camera = invert(T_world_camera.matrix)
    planes = []
    for key, sample in sorted(record.samples(LIT).items()):
        data = sample.data
        if data["flaw"]:
            continue
        pose = camera @ np.array(data["T_world_flange"]) @ T_flange_board.matrix
        planes.append(
            LitPlane(key, np.array(data["projector_px"]), np.array(data["camera_px"]), pose)
        )
    return planes
