"""Camera intrinsics from views of the checkerboard that the arm holds before the camera."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import intrinsic
from cellctl.calib.intrinsic import IntrinsicResult
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.errors import SolveError
from cellctl.procedures import sweep
from cellctl.procedures.belief import Belief
from cellctl.procedures.capture import CaptureLimits
from cellctl.procedures.knowledge import board_of, factory_camera, known
from cellctl.procedures.observations import Collected, collected
from cellctl.procedures.parking import lit_area
from cellctl.procedures.planning import Spread
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run

BOARD = "checkerboard"
COVERAGE_OF_LIGHT = 2.0
SPREAD = Spread(fill=(0.2, 0.5), spin_deg=25.0, to_the_edges=True)


class IntrinsicParams(BaseModel):
    """`views` good pictures; `search` poses at most in which the board is looked for; `seed`
    draws other candidates to choose views from."""

    model_config = ConfigDict(extra="forbid")

    views: int = Field(default=30, ge=6, le=200)
    search: int = Field(default=16, ge=1, le=100)
    seed: int = Field(default=0, ge=0)
    max_held_out_px: float = Field(default=0.5, gt=0)


def sweep_of(config: CellConfig, params: IntrinsicParams) -> sweep.Sweep:
    """Which views to show."""
    board = board_of(config, BOARD)
    return sweep.Sweep(board, params.views, SPREAD, CaptureLimits(), params.search, params.seed)


async def collect(run: Run, cell: Cell, params: IntrinsicParams, belief: Belief) -> Belief:
    """Show the checkerboard; the samples are in the run."""
    return await sweep.collect(run, cell, sweep_of(cell.config, params), belief)


def seen(record: Record[IntrinsicParams]) -> Collected:
    """The views that were recorded."""
    return collected(record, sweep.VIEWS, board_of(record.config, BOARD))


def solve(views: Collected) -> IntrinsicResult:
    """Pure: the camera from what was seen."""
    return intrinsic.solve_intrinsic(
        views.views, views.image_size, minimum_points=views.minimum_points
    )


def judge(
    result: IntrinsicResult, params: IntrinsicParams, config: CellConfig
) -> tuple[str, tuple[str, ...]]:
    """Pass or fail, with reasons."""
    limits = intrinsic.IntrinsicLimits(
        views=max(6, params.views // 2),
        held_out_px=params.max_held_out_px,
        coverage=needed_coverage(config),
    )
    return intrinsic.judge(result, limits)


def needed_coverage(config: CellConfig) -> float:
    """Which part of the picture the views must cover: COVERAGE_OF_LIGHT times what the light on
    the table takes of it, as far as tape and data sheets tell, but no more than the usual limit.
    A camera that sees far beyond the light is asked for nothing out there."""
    corners, camera = lit_area(config), factory_camera(config)
    distance = config.camera.pose.position_m[2] - config.table.touched_height_m
    area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[3] - corners[0]))
    light = area * camera.K[0, 0] * camera.K[1, 1] / (distance**2 * np.prod(camera.image_size))
    return min(COVERAGE_OF_LIGHT * float(light), intrinsic.IntrinsicLimits.coverage)


def conclude(record: Record[IntrinsicParams]) -> Result:
    """Pure: from what was recorded to the result."""
    views = seen(record)
    try:
        result = solve(views)
    except SolveError as error:
        return Result.unsolved("intrinsic", error)
    _, reasons = judge(result, record.params, record.config)
    return Result.judged(reasons, {"kind": "intrinsic", **views.merged(result.to_dict())})


async def run_intrinsic(run: Run, cell: Cell, params: IntrinsicParams) -> Result:
    """Collect, solve, judge."""
    belief = known(cell.config, run.calibration).belief(cell.config, BOARD)
    await collect(run, cell, params, belief)
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="intrinsic",
    summary="Camera intrinsics: shows the checkerboard to the camera from many sides",
    params=IntrinsicParams,
    moves=True,
    run=run_intrinsic,
    conclude=conclude,
)
