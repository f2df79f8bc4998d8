"""The projector: markers are shown on the free table and found by the camera.

Several pictures, because 12 x 20 markers at once would be too small in the camera. In the end the
first one is shown again: what moved in between spoils the result, and is noticed. With `dense` the
pictures between are those of a Gray code (procedures/light_code.py).
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import dense, patterns, projector
from cellctl.calib.calibration import Calibration
from cellctl.calib.camera import CameraModel
from cellctl.calib.dense import CodeSeen
from cellctl.calib.projector import LensPrior, ProjectorResult
from cellctl.calib.second_plane import LitPlane, full_projector
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.errors import BadInput, DeviceFault, SolveError
from cellctl.procedures import light_code, lit_board
from cellctl.procedures.capture import darken, grab_still, mean_image
from cellctl.procedures.knowledge import Knowledge, known, lens_prior, table_plane
from cellctl.procedures.observations import picture
from cellctl.procedures.parking import park
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run
from cellctl.store.history import Sample

BEFORE, PICTURES, AGAIN = "before", "pictures", "again"
FRAMES = 4
DETECT_TIMEOUT_S = 30.0

Markers = dict[int, Any]
"""Centres {id: (2,)} in pixels."""


class ProjectorParams(BaseModel):
    """The grid of markers and in how many pictures it is shown; or, `dense`, a Gray code whose
    finest stripes are `stripe_px` projector pixels wide. So many times the marker board is `held`
    into the light, which shows the projector's full model; that needs a hand-eye."""

    model_config = ConfigDict(extra="forbid")

    columns: int = Field(default=20, ge=4, le=50)
    rows: int = Field(default=12, ge=3, le=50)
    pictures: int = Field(default=4, ge=1, le=16)
    dense: bool = False
    stripe_px: int = Field(default=8, ge=2, le=64)
    held: int = Field(default=0, ge=0, le=20)
    max_held_out_px: float = Field(default=2.0, gt=0)
    max_shift_px: float = Field(default=0.3, gt=0)


@dataclass(frozen=True, eq=False)
class Shown:
    """What the camera found: markers in each picture, and where the projector put them. If a
    code was shown these are places of a grid, and `code` is all that was read."""

    pictures: list[Markers]
    centres: Markers
    before: Markers
    again: Markers
    code: CodeSeen | None = None


def pictures_of(config: CellConfig, params: ProjectorParams) -> list[patterns.MarkerPicture]:
    """What is shown."""
    return patterns.marker_pictures(
        config.projector.size_px, params.columns, params.rows, pictures=params.pictures
    )


async def collect(run: Run, cell: Cell, params: ProjectorParams, knowledge: Knowledge) -> None:
    """Park the arm, show all pictures, and the first one again; then hold the marker board into
    the light. BadInput when it is not known how the arm holds it."""
    if params.held and lit_board.BOARD not in knowledge.boards:
        raise BadInput("held: how the arm holds the marker board is not known yet; run full first")
    shown = pictures_of(cell.config, params)
    if not run.samples(AGAIN):
        await park(run, cell, knowledge.T_world_camera, PICTURES)
    if params.dense:
        await _take(run, cell, BEFORE, shown[:1])
        await light_code.take(run, cell, params.stripe_px)
    else:
        await _take(run, cell, PICTURES, shown)
    await _take(run, cell, AGAIN, shown[:1])
    await darken(cell)
    if params.held:
        belief = knowledge.belief(cell.config, lit_board.BOARD)
        await lit_board.collect(run, cell, belief, params.held, params.stripe_px)


async def look_before(run: Run, cell: Cell, params: ProjectorParams, knowledge: Knowledge) -> None:
    """Show the first picture, for comparison at the end of a long run."""
    if run.samples(BEFORE):
        return
    await park(run, cell, knowledge.T_world_camera, BEFORE)
    await _take(run, cell, BEFORE, pictures_of(cell.config, params)[:1])


async def _take(run: Run, cell: Cell, step: str, shown: list[patterns.MarkerPicture]) -> None:
    await run.step(step, len(shown))
    for i, pattern in enumerate(shown):
        key = f"picture-{i}"
        if key in run.samples():
            continue
        await run.checkpoint(f"{key} is shown")
        async with run.taking(key):
            on_glass = await cell.projector.show(pattern.image)
            frames = await grab_still(cell, on_glass, FRAMES)
            image = await asyncio.to_thread(mean_image, frames)
        found = await run.call(patterns.detect_markers, image, timeout_s=DETECT_TIMEOUT_S)
        _refuse_another_picture(found, pattern.centres)
        await run.sample(key, {"markers": markers_data(found)}, {"image": image})
        run.progress(i + 1)


def _refuse_another_picture(found: Markers, shown: Markers) -> None:
    """DeviceFault when most markers that the camera sees are not in the picture shown."""
    strange = found.keys() - shown.keys()
    if 2 * len(strange) > len(found):
        raise DeviceFault(
            f"{len(strange)} of {len(found)} markers that the camera sees are not in the picture "
            "shown: is projector.latency_s too short, or does another program use the projector?"
        )


def markers_data(found: Mapping[int, Any]) -> dict[str, list[float]]:
    """The JSON form of found markers."""
    return {str(number): [float(v) for v in centre] for number, centre in sorted(found.items())}


def journalled(sample: Sample) -> Markers:
    """The markers that were found when the sample was taken."""
    return {int(n): np.array(centre) for n, centre in sample.data["markers"].items()}


def seen(record: Record[ProjectorParams]) -> Shown:
    """What was recorded; without a look before, the first picture is compared with the last."""
    shown = pictures_of(record.config, record.params)
    if record.params.dense:
        return _seen_densely(record, shown[:1])
    pictures = _found(record, PICTURES, shown)
    return Shown(
        pictures=pictures,
        centres={number: c for pattern in shown for number, c in pattern.centres.items()},
        before=(_found(record, BEFORE, shown) or pictures)[0],
        again=_found(record, AGAIN, shown)[0],
    )


def _seen_densely(record: Record[ProjectorParams], first: list[patterns.MarkerPicture]) -> Shown:
    code = light_code.seen(record, record.params.stripe_px)
    places, pixels = code.markers
    return Shown(
        pictures=[places],
        centres=pixels,
        before=_found(record, BEFORE, first)[0],
        again=_found(record, AGAIN, first)[0],
        code=code,
    )


def _found(
    record: Record[ProjectorParams], step: str, shown: list[patterns.MarkerPicture]
) -> list[Markers]:
    """What was found, in each picture that was taken, of what was shown there: a marker of
    another picture's is something else, such as print that looks like one."""
    samples = record.samples(step)
    taken = [(pattern, samples.get(f"picture-{i}")) for i, pattern in enumerate(shown)]
    return [
        {n: c for n, c in _markers_in(sample, again=record.again).items() if n in pattern.centres}
        for pattern, sample in taken
        if sample is not None
    ]


def _markers_in(sample: Sample, *, again: bool) -> Markers:
    return patterns.detect_markers(picture(sample)) if again else journalled(sample)


def solve(shown: Shown, camera: CameraModel, lens: LensPrior) -> ProjectorResult:
    """Pure: the map from the camera's to the projector's picture."""
    if shown.code is not None:
        return dense.solve_dense(shown.code, camera, lens=lens)
    return projector.solve_projector(shown.pictures, shown.centres, camera, lens=lens)


def judge(
    result: ProjectorResult, shown: Shown, params: ProjectorParams
) -> tuple[str, tuple[str, ...]]:
    """Pass or fail, with reasons; a shift between first and last look fails."""
    limits = projector.ProjectorLimits(
        held_out_px=params.max_held_out_px, shift_px=params.max_shift_px
    )
    shift = projector.shift_px(shown.before, shown.again)
    return projector.judge(result, limits, shift=shift)


def conclude(record: Record[ProjectorParams]) -> Result:
    """Pure: from what was recorded to the result. A calibration comes of it when the hand-eye
    was known already."""
    shown, knowledge = seen(record), known(record.config, record.active)
    try:
        result = solve(shown, knowledge.camera, lens_prior(record.config))
        _, reasons = judge(result, shown, record.params)
    except SolveError as error:
        return Result.unsolved("projector", error)
    reasons = (*reasons, *_upside_down(record.config, knowledge, result))
    data = {"kind": "projector", **result.to_dict()}
    calibration = _calibration(record.config, knowledge, result)
    if calibration is not None and record.params.held:
        data["full_model"], why = full_model(record, calibration, shown)
        reasons = (*reasons, *why)
    return Result.judged(reasons, data, calibration.to_dict() if calibration else None)


def full_model(
    record: Record[ProjectorParams], calibration: Calibration, shown: Shown
) -> tuple[dict[str, Any] | None, tuple[str, ...]]:
    """Pure: the projector in the robot's frame, from the table and the boards that were held into
    the light; None, and why, when these do not tell it."""
    pose, board = calibration.T_world_camera, calibration.boards[lit_board.BOARD]
    lit = [(shown.centres[n], place) for p in shown.pictures for n, place in p.items()]
    pixels, places = (np.array(side) for side in zip(*lit, strict=True))
    planes = [
        LitPlane("table", pixels, places, calibration.table_frame),
        *lit_board.seen(record, pose, board),
    ]
    size, lens = record.config.projector.size_px, lens_prior(record.config)
    try:
        found = full_projector(planes, calibration.camera, pose, size, lens)
    except SolveError as error:
        return None, (error.message,)
    return found.to_dict(), ()


def _upside_down(
    config: CellConfig, knowledge: Knowledge, result: ProjectorResult
) -> tuple[str, ...]:
    """As the projector's tape-measured pose has it, which no tape gets wrong by a quarter turn."""
    pose = config.projector.pose.transform("world", "projector")
    middle = np.array(config.projector.size_px) / 2.0
    turn = projector.turned_deg(
        result.map,
        knowledge.T_world_camera.matrix,
        pose.matrix,
        lens_prior(config),
        spot=_on_table(config, knowledge, result.map.locate(middle)),
    )
    return projector.judge_turn(turn)


def _on_table(config: CellConfig, knowledge: Knowledge, xy: Any) -> Any:
    """The point (3,) of the world's table at normalised camera coordinates (2,)."""
    T = knowledge.T_world_camera.matrix
    ray = T[:3, :3] @ np.append(xy, 1.0)
    return T[:3, 3] + ray * (config.table.touched_height_m - T[2, 3]) / ray[2]


def _calibration(
    config: CellConfig, knowledge: Knowledge, result: ProjectorResult
) -> Calibration | None:
    """The active calibration with this projector; None when there was none."""
    if not knowledge.calibrated:
        return None
    return Calibration(
        camera=knowledge.camera,
        T_world_camera=knowledge.T_world_camera,
        table=table_plane(config),
        projector=result.map,
        boards=knowledge.boards,
    )


async def run_projector(run: Run, cell: Cell, params: ProjectorParams) -> Result:
    """Collect, solve, judge."""
    await collect(run, cell, params, known(cell.config, run.calibration))
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="projector",
    summary="Projector: shows markers on the free table and finds them with the camera",
    params=ProjectorParams,
    moves=True,
    run=run_projector,
    conclude=conclude,
)
