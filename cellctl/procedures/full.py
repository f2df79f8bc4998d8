"""Everything that there is, one after the other: intrinsic, hand-eye, projector.

Each part is the procedure that also runs alone, in a scope of its own; what one part found out is
what the next one starts from. The verdict is that of all parts together.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pydantic import BaseModel, ConfigDict

from cellctl.calib import stages
from cellctl.calib.calibration import Calibration
from cellctl.cell import Cell
from cellctl.procedures import hand_eye, intrinsic, projector
from cellctl.procedures.belief import Belief
from cellctl.procedures.hand_eye import HandEyeParams
from cellctl.procedures.intrinsic import IntrinsicParams
from cellctl.procedures.knowledge import (
    Knowledge,
    factory_camera,
    known,
    lens_prior,
    table_plane,
)
from cellctl.procedures.projector import ProjectorParams
from cellctl.procedures.record import Record, recorded
from cellctl.run import Procedure, Result, Run

INTRINSIC, HAND_EYE, PROJECTOR = "intrinsic", "hand-eye", "projector"


class FullParams(BaseModel):
    """The parameters of the parts."""

    model_config = ConfigDict(extra="forbid")

    intrinsic: IntrinsicParams = IntrinsicParams()
    hand_eye: HandEyeParams = HandEyeParams()
    projector: ProjectorParams = ProjectorParams()


async def run_full(run: Run, cell: Cell, params: FullParams) -> Result:
    """Collect all, then solve and judge all together."""
    start = known(cell.config, run.calibration)
    await projector.look_before(run.scope(PROJECTOR), cell, params.projector, start)
    belief = start.belief(cell.config, intrinsic.BOARD)
    belief = await intrinsic.collect(run.scope(INTRINSIC), cell, params.intrinsic, belief)
    belief = await run.call(_next_belief, _record(run, cell, params), start, belief)
    belief = await hand_eye.collect(run.scope(HAND_EYE), cell, params.hand_eye, belief)
    found = Knowledge(belief.camera, belief.T_world_camera, calibrated=True, boards={})
    await projector.collect(run.scope(PROJECTOR), cell, params.projector, found)
    return await run.call(conclude, _record(run, cell, params))


def _record(run: Run, cell: Cell, params: FullParams) -> Record[FullParams]:
    return recorded(run, cell.config, params)


def _next_belief(record: Record[FullParams], start: Knowledge, belief: Belief) -> Belief:
    """What the search for the marker board starts from: the calibrated camera, where the
    checkerboard showed it to hang, and the marker board's pose as it was known."""
    checker = intrinsic.seen(record.scoped(INTRINSIC, record.params.intrinsic))
    camera = intrinsic.solve(checker).camera
    belief = replace(belief, camera=camera).updated(checker.views)
    found = Knowledge(camera, belief.T_world_camera, calibrated=True, boards=start.boards)
    return found.belief(record.config, hand_eye.BOARD)


def conclude(record: Record[FullParams]) -> Result:
    """Pure: from what was recorded to all results, the stage table and the calibration."""
    config, params = record.config, record.params
    checker = intrinsic.seen(record.scoped(INTRINSIC, params.intrinsic))
    markers = hand_eye.seen(record.scoped(HAND_EYE, params.hand_eye))
    shown = projector.seen(record.scoped(PROJECTOR, params.projector))
    camera = intrinsic.solve(checker)
    pose = hand_eye.solve(markers, camera.camera)
    light = projector.solve(shown, camera.camera, lens_prior(config))
    verdicts = {
        INTRINSIC: intrinsic.judge(camera, params.intrinsic),
        HAND_EYE: hand_eye.judge(pose, params.hand_eye),
        PROJECTOR: projector.judge(light, shown, params.projector),
    }
    calibration = Calibration(
        camera=camera.camera,
        T_world_camera=pose.camera_pose,
        table=table_plane(config),
        projector=light.map,
        boards={hand_eye.BOARD: pose.board_pose},
    )
    cell = stages.CellData(
        intrinsic=checker.views,
        hand_eye=markers.views,
        pictures=shown.pictures,
        centres=shown.centres,
        factory=factory_camera(config),
        table=table_plane(config),
        lens=lens_prior(config),
    )
    table = stages.solve_stages(cell, intrinsic=camera, hand_eye=pose)
    reasons = [f"{part}: {reason}" for part, (_, why) in verdicts.items() for reason in why]
    data = {
        "kind": "full",
        INTRINSIC: _part(verdicts[INTRINSIC], checker.merged(camera.to_dict())),
        HAND_EYE: _part(verdicts[HAND_EYE], markers.merged(pose.to_dict())),
        PROJECTOR: _part(verdicts[PROJECTOR], light.to_dict()),
        "stages": [_row(stage) for stage in table],
    }
    return Result.judged(reasons, data, calibration.to_dict())


def _row(stage: stages.Stage) -> dict[str, Any]:
    return {
        "name": stage.name,
        "training_px": stage.training_px,
        "held_out_px": stage.held_out_px,
        "calibration": stage.calibration.to_dict(),
    }


def _part(judged: tuple[str, tuple[str, ...]], data: dict[str, Any]) -> dict[str, Any]:
    verdict, reasons = judged
    return {"verdict": verdict, "reasons": list(reasons), **data}


PROCEDURE = Procedure(
    name="full",
    summary="Everything, unattended: intrinsic, hand-eye, projector, and the verdict",
    params=FullParams,
    moves=True,
    run=run_full,
    conclude=conclude,
)
