"""Camera intrinsics from views of the checkerboard that the arm holds before the camera."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import intrinsic
from cellctl.calib.intrinsic import IntrinsicResult
from cellctl.cell import Cell
from cellctl.config import CellConfig
from cellctl.errors import SolveError
from cellctl.procedures import sweep
from cellctl.procedures.belief import Belief
from cellctl.procedures.capture import CaptureLimits
from cellctl.procedures.knowledge import board_of, known
from cellctl.procedures.observations import Collected, collected
from cellctl.procedures.planning import Spread
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run

BOARD = "checkerboard"
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


def judge(result: IntrinsicResult, params: IntrinsicParams) -> tuple[str, tuple[str, ...]]:
    """Pass or fail, with reasons."""
    return intrinsic.judge(
        result,
        intrinsic.IntrinsicLimits(
            views=max(6, params.views // 2), held_out_px=params.max_held_out_px
        ),
    )


def conclude(record: Record[IntrinsicParams]) -> Result:
    """Pure: from what was recorded to the result."""
    views = seen(record)
    try:
        result = solve(views)
    except SolveError as error:
        return Result.unsolved("intrinsic", error)
    _, reasons = judge(result, record.params)
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
