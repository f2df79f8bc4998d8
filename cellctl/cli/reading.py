"""Commands that read from the daemon, and `promote`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from cellctl.bus.client import Client
from cellctl.cli import words
from cellctl.cli.options import HERE, AsJson, CellId, Connect, connect
from cellctl.cli.output import emit, out, say
from cellctl.cli.results import print_data, print_run, print_table, print_verdict
from cellctl.errors import NotFound
from cellctl.messages import CalibrationInfo, RunInfo, Runs, State


def status(as_json: AsJson = False, endpoint: Connect = HERE, cell: CellId = None) -> None:
    """What the cell is doing, on one screen."""
    with connect(endpoint, cell) as client:
        state = client.state()
        runs = Runs(runs=[]) if as_json else client.runs(limit=5)
    if as_json:
        emit(state)
        return
    _print_state(state, endpoint)
    if runs.runs:
        out.print()
        _print_runs(runs)


def _print_state(state: State, endpoint: str) -> None:
    grid = Table.grid(padding=(0, 2))
    grid.add_column()
    grid.add_column(overflow="fold")  # a command that is cut short helps nobody
    kind = "simulated" if state.simulated else "real"
    rows = {
        "cell": f"{state.cell} ({kind}) at {endpoint}",
        "phase": words.standing(state),
        "step": words.progress(state.progress) if state.progress else None,
        "asks": state.question.text if state.question else None,
        "answer": _commands(state),
        "motion": words.motion(state),
        "calibration": state.active_calibration or "none is active",
    }
    for name, value in rows.items():
        if value:
            grid.add_row(name, value)
    out.print(grid, markup=False)


def _commands(state: State) -> str | None:
    if state.question:
        asked = state.question
        return "\n".join(words.answer_command(choice, asked.id) for choice in asked.choices)
    return "when it is put right: cellctl ack" if state.phase == "fault" else None


def runs(
    limit: Annotated[int, typer.Option(min=1, help="At most so many, the newest.")] = 20,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """The newest runs."""
    with connect(endpoint, cell) as client:
        known = client.runs(limit)
    if as_json:
        emit(known)
    elif known.runs:
        _print_runs(known)
    else:
        say("There are no runs yet. Start one with `cellctl run PROCEDURE`.")


def _print_runs(known: Runs) -> None:
    rows = [
        {
            "run": run.run_id,
            "procedure": run.procedure,
            "status": run.status,
            "verdict": run.verdict,
            "samples": run.samples,
            "why": run.error or (run.reasons[0] if run.reasons else None),
        }
        for run in known.runs
    ]
    print_table("newest runs", rows)


def show(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[RUN|CALIBRATION]", help="`active` is one too; none: the newest."),
    ] = None,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """A run or a calibration, whole; the newest run if none is named."""
    with connect(endpoint, cell) as client:
        found = _find(client, name)
    if as_json:
        emit(found)
    elif isinstance(found, RunInfo):
        print_run(found)
    else:
        _print_calibration(found)


def newest_run(client: Client) -> str:
    """Its id. NotFound when there is none."""
    known = client.runs(limit=1).runs
    if not known:
        raise NotFound("there are no runs yet; start one with `cellctl run PROCEDURE`")
    return known[0].run_id


def _find(client: Client, name: str | None) -> RunInfo | CalibrationInfo:
    if name is None:
        return client.run_info(newest_run(client))
    try:
        return client.calibration(name) if name == "active" else client.run_info(name)
    except NotFound as error:
        if name == "active":
            raise
        missing = error
    try:
        return client.calibration(name)
    except NotFound:
        raise NotFound(f"neither a run nor a calibration: {missing.message}") from None


def _print_calibration(found: CalibrationInfo) -> None:
    state = "the active calibration" if found.active else "not active"
    say(f"{found.calibration_id}: {state}")
    if "verdict" in found.document:
        print_verdict(found.document["verdict"], found.document.get("reasons"))
    rest = {k: v for k, v in found.document.items() if k not in ("verdict", "reasons")}
    print_data(rest)


def procedures(as_json: AsJson = False, endpoint: Connect = HERE, cell: CellId = None) -> None:
    """What can be run, and with which parameters."""
    with connect(endpoint, cell) as client:
        known = client.procedures()
    if as_json:
        emit(known)
        return
    rows = [
        {
            "procedure": procedure.name,
            "moves": procedure.moves,
            "what it does": procedure.summary,
            "parameters": " ".join(procedure.params.get("properties", {})) or "none",
        }
        for procedure in known.procedures
    ]
    print_table("procedures", rows)


def promote(
    calibration_id: Annotated[str, typer.Argument(metavar="CALIBRATION")],
    despite_failed_verdict: Annotated[
        bool, typer.Option("--despite-failed-verdict", help="Even if its verdict is fail.")
    ] = False,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """Make a calibration the one that is in use."""
    with connect(endpoint, cell) as client:
        accepted = client.promote(calibration_id, despite_failed_verdict=despite_failed_verdict)
    if as_json:
        emit(accepted)
    else:
        say(accepted.message)
