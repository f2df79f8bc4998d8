"""A recorded run solved again, offline: the same pure part, on pictures and poses from disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cellctl.config import parse_config
from cellctl.errors import BadInput
from cellctl.procedures import PROCEDURES
from cellctl.procedures.record import Record
from cellctl.store import calibrations
from cellctl.store.files import read_document
from cellctl.store.run_folder import RecordedRun, read_run

SOLVABLE = ("done",)
"""A run that was cut short has not seen all that its solver needs."""


def solve_run(directory: Path) -> dict[str, Any]:
    """Detect and solve again what the run in `directory` recorded; nothing is changed.

    Returns the verdict, its reasons and what the run's result.json has under `data`. BadInput
    names a file that is missing or damaged, or a procedure that cannot be solved again.
    """
    run = read_run(directory)
    procedure = PROCEDURES.get(run.header.procedure)
    if procedure is None or procedure.conclude is None:
        raise BadInput(f"{directory}: a {run.header.procedure!r} run cannot be solved again")
    if run.standing.status not in SOLVABLE:
        raise BadInput(
            f"{directory}: the run is {run.standing.status}; only one that is done can be solved "
            f"again (`cellctl run --resume {run.header.run_id}` finishes it)"
        )
    config = parse_config(run.header.config, str(directory / "run.json"))
    active = _active(directory, run)
    record = Record(
        config, procedure.parse(run.header.params), active, run.history.steps(), again=True
    )
    result = procedure.conclude(record)
    return {"verdict": result.verdict, "reasons": list(result.reasons), **result.data}


def _active(directory: Path, run: RecordedRun) -> dict[str, Any] | None:
    """The calibration that was active when the run was made, from beside the run."""
    name = run.header.active_calibration
    if name is None:
        return None
    path = directory.absolute().parents[1] / "calibrations" / f"{name}.json"
    try:
        document: dict[str, Any] = read_document(path, calibrations.FILE)["calibration"]
    except (BadInput, KeyError) as error:
        raise BadInput(
            f"{path}: the run started from this calibration, and needs it to be solved: {error}"
        ) from None
    return document
