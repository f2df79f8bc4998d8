"""Hand-eye: where the camera hangs, and how the bracket holds the marker board (paper, Eq. 7)."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import hand_eye
from cellctl.calib.camera import CameraModel
from cellctl.calib.hand_eye import HandEyeResult
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

BOARD = "markers"
SPREAD = Spread(fill=(0.2, 0.35), about_camera=True)


class HandEyeParams(BaseModel):
    """`views` good pictures; `search` poses at most in which the board is looked for; `seed`
    draws other candidates to choose views from."""

    model_config = ConfigDict(extra="forbid")

    views: int = Field(default=10, ge=5, le=100)
    search: int = Field(default=16, ge=1, le=100)
    seed: int = Field(default=0, ge=0)
    max_held_out_px: float = Field(default=2.0, gt=0)


def sweep_of(config: CellConfig, params: HandEyeParams) -> sweep.Sweep:
    """Which views to show."""
    board = board_of(config, BOARD)
    return sweep.Sweep(board, params.views, SPREAD, CaptureLimits(), params.search, params.seed)


async def collect(run: Run, cell: Cell, params: HandEyeParams, belief: Belief) -> Belief:
    """Show the marker board; the samples are in the run."""
    return await sweep.collect(run, cell, sweep_of(cell.config, params), belief)


def seen(record: Record[HandEyeParams]) -> Collected:
    """The views that were recorded."""
    return collected(record, sweep.VIEWS, board_of(record.config, BOARD))


def solve(views: Collected, camera: CameraModel) -> HandEyeResult:
    """Pure: T_world_camera and T_flange_markers from what was seen."""
    return hand_eye.solve_hand_eye(
        views.views,
        "eye-to-hand",
        camera=camera,
        board=BOARD,
        minimum_points=views.minimum_points,
    )


def judge(result: HandEyeResult, params: HandEyeParams) -> tuple[str, tuple[str, ...]]:
    """Pass or fail, with reasons."""
    limits = hand_eye.HandEyeLimits(
        views=max(5, params.views // 2), held_out_px=params.max_held_out_px
    )
    return hand_eye.judge(result, limits)


def conclude(record: Record[HandEyeParams]) -> Result:
    """Pure: from what was recorded, and the camera that was known, to the result."""
    views = seen(record)
    try:
        result = solve(views, known(record.config, record.active).camera)
    except SolveError as error:
        return Result.unsolved("hand-eye", error)
    _, reasons = judge(result, record.params)
    data: dict[str, Any] = {"kind": "hand-eye", **views.merged(result.to_dict())}
    return Result.judged(reasons, data)


async def run_hand_eye(run: Run, cell: Cell, params: HandEyeParams) -> Result:
    """Collect, solve, judge; with the active calibration's camera, or the factory's."""
    belief = known(cell.config, run.calibration).belief(cell.config, BOARD)
    await collect(run, cell, params, belief)
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="hand-eye",
    summary="Hand-eye: shows the marker board to the camera and ties camera to robot",
    params=HandEyeParams,
    moves=True,
    run=run_hand_eye,
    conclude=conclude,
)
