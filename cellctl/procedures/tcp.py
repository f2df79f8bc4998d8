"""The pen's tip on the flange, by pivoting: an operator jogs the tip onto one fixed point, several
times, with the tool turned otherwise. Nothing here moves the arm."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cellctl.calib import tcp
from cellctl.calib.tcp import PivotResult
from cellctl.cell import Cell
from cellctl.errors import BadInput
from cellctl.geometry import Transform
from cellctl.procedures.record import Record, recorded
from cellctl.run import CANCEL, Procedure, Result, Run, StepCancelled
from cellctl.store.history import Sample

POSES = "poses"
TAKEN = "the tip is on the point"


class TcpParams(BaseModel):
    """`poses` with the tip on the point; `max_held_out_mm` is what they may disagree by."""

    model_config = ConfigDict(extra="forbid")

    poses: int = Field(default=6, ge=4, le=50)
    max_held_out_mm: float = Field(default=1.0, gt=0)


async def collect(run: Run, cell: Cell, params: TcpParams) -> None:
    """Ask for all poses; the samples are in the run."""
    await run.step(POSES, params.poses)
    for i in range(params.poses):
        key = f"pose-{i:02}"
        run.progress(i)
        if key in run.samples():
            continue
        answer = await run.ask(
            f"Pose {i + 1} of {params.poses}: jog the pen's tip onto the fixed point, with the "
            "tool turned or tilted by 30 degrees or more from the poses before",
            [TAKEN, CANCEL],
        )
        if answer == CANCEL:
            raise StepCancelled
        state = await cell.robot.read()
        if state.standstill_s == 0.0:
            raise BadInput(f"{key}: the arm was still moving; start again and wait for standstill")
        await run.sample(
            key,
            {
                "T_world_flange": state.T_world_flange.to_list(),
                "joints": state.joints.tolist(),
                "t": state.t,
            },
        )


def solve(record: Record[TcpParams]) -> PivotResult:
    """Pure: the tip from the recorded poses."""
    samples = sorted(record.samples(POSES).items())
    poses = np.array([_pose(sample) for _, sample in samples]).reshape(-1, 4, 4)
    return tcp.solve_tip(poses, ids=[key for key, _ in samples])


def _pose(sample: Sample) -> Any:
    try:
        return Transform("world", "flange", sample.data["T_world_flange"]).matrix
    except (KeyError, BadInput) as error:
        raise BadInput(f"sample {sample.key}: T_world_flange: {error}") from None


def conclude(record: Record[TcpParams]) -> Result:
    """Pure: from what was recorded to the tip, beside what the config says."""
    result = solve(record)
    limits = tcp.PivotLimits(held_out_mm=record.params.max_held_out_mm)
    _, reasons = tcp.judge(result, limits)
    stated = np.array(record.config.bracket.pen.tip_m)
    data = {
        "kind": "tcp",
        **result.to_dict(),
        "stated_tip_m": stated.tolist(),
        "off_mm": (1e3 * (result.tip - stated)).tolist(),
    }
    return Result.judged(reasons, data)


async def run_tcp(run: Run, cell: Cell, params: TcpParams) -> Result:
    """Collect, solve, judge."""
    await collect(run, cell, params)
    return await run.call(conclude, recorded(run, cell.config, params))


PROCEDURE = Procedure(
    name="tcp",
    summary="Pen: where its tip is on the flange, from poses that an operator jogs to",
    params=TcpParams,
    moves=False,
    run=run_tcp,
    conclude=conclude,
)
