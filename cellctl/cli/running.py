"""Commands that start, follow and steer runs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Annotated

import typer
from pydantic import BaseModel

from cellctl.bus.client import Client
from cellctl.bus.follow import Update
from cellctl.cli import words
from cellctl.cli.display import ProgressBar, follow
from cellctl.cli.options import HERE, AsJson, CellId, Connect, GiveUp, connect, parse_params
from cellctl.cli.output import emit, note, say
from cellctl.cli.results import print_run
from cellctl.errors import BadInput, CellctlError
from cellctl.messages import RunAccepted, RunInfo, State

DETACHED_BY_USER = 130
"""As of a program that Ctrl-C has ended: the run's outcome is not known."""


def _complete(incomplete: str) -> list[str]:
    """The names of a live daemon's procedures; none when nobody answers at once."""
    endpoint, cell = os.environ.get("CELLCTL_CONNECT", HERE), os.environ.get("CELLCTL_CELL")
    try:
        with Client(endpoint, cell, settings={"connect/timeout_ms": 300}) as client:
            names = [procedure.name for procedure in client.procedures().procedures]
    except CellctlError:
        return []
    return [name for name in names if name.startswith(incomplete)]


def run(
    procedure: Annotated[str | None, typer.Argument(autocompletion=_complete)] = None,
    param: Annotated[list[str] | None, typer.Option("--param", metavar="NAME=VALUE")] = None,
    dense: Annotated[
        bool, typer.Option("--dense", help="With projector: a Gray code, as --param dense=true.")
    ] = False,
    resume: Annotated[str | None, typer.Option(metavar="RUN", help="Go on with a run.")] = None,
    step: Annotated[bool, typer.Option("--step", help="Ask before every motion.")] = False,
    speed: Annotated[float, typer.Option(help="Percent of the configured speed.")] = 100.0,
    request_id: Annotated[
        str | None, typer.Option(help="The same id again is the same run, not another.")
    ] = None,
    detach: Annotated[bool, typer.Option("--detach", help="Do not wait for the end.")] = False,
    give_up: GiveUp = None,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> int:
    """Start a procedure, or go on with a run, and wait for its result. Ctrl-C detaches."""
    params = parse_params([*(param or []), *(["dense=true"] if dense else [])])
    if resume and (params or step or speed != 100.0 or request_id):
        raise BadInput("--resume goes on as the run was started: no --param, --step or --speed")
    with connect(endpoint, cell) as client:
        if resume:
            accepted = _resume(client, resume, procedure)
        elif procedure:
            accepted = client.run(procedure, params, request_id=request_id, speed=speed, step=step)
        else:
            raise BadInput("name a procedure, or a run with --resume; see `cellctl procedures`")
        if detach:
            return _say_started(accepted, as_json)
        return _wait(client, accepted, give_up, as_json)


def _resume(client: Client, run_id: str, procedure: str | None) -> RunAccepted:
    if procedure and (actual := client.run_info(run_id).procedure) != procedure:
        raise BadInput(f"run {run_id} is one of {actual}, not of {procedure}")
    return client.resume(run_id)


def _say_started(accepted: RunAccepted, as_json: bool) -> int:
    if as_json:
        emit(accepted)
    else:
        say(accepted.run_id)
    return 0


def _wait(client: Client, accepted: RunAccepted, give_up: float | None, as_json: bool) -> int:
    if accepted.replayed:
        note(f"this is run {accepted.run_id}, which was started before")
    try:
        ended = follow(client, accepted.run_id, give_up)
    except KeyboardInterrupt:
        for text in words.detached(accepted.run_id):
            note(text)
        if as_json:
            emit({**accepted.model_dump(), "detached": True})
        return DETACHED_BY_USER
    return conclude(ended, as_json)


def conclude(run: RunInfo, as_json: bool) -> int:
    """Print a run that has ended; returns the exit code."""
    if as_json:
        emit(run)
    else:
        print_run(run)
    return exit_code(run)


def exit_code(run: RunInfo) -> int:
    """Of a run that has ended."""
    return 0 if run.status == "done" and run.verdict != "fail" else 1


def watch(
    run_id: Annotated[str | None, typer.Argument(metavar="[RUN]")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object a line, for each update.")
    ] = False,
    give_up: GiveUp = None,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> int:
    """Follow the cell until Ctrl-C, or one run until it ends, also over a daemon's restart."""
    try:
        with connect(endpoint, cell) as client, ProgressBar() as bar:
            for update in _news(client.watch(run_id, give_up_s=give_up)):
                bar.show(update)
                if as_json:
                    fields = update.model_dump() if isinstance(update, BaseModel) else vars(update)
                    emit({"type": type(update).__name__, **fields})
                elif isinstance(update, RunInfo):
                    print_run(update)
                elif text := words.line(update):
                    bar.say(text)
                if isinstance(update, RunInfo):
                    return exit_code(update)
    except KeyboardInterrupt:
        pass
    return 0


def _news(updates: Iterable[Update]) -> Iterator[Update]:
    """Without the states that only repeat the one before."""
    last: State | None = None
    for update in updates:
        if isinstance(update, State):
            same = {"wall_time": 0.0, "seq": 0, "progress": None}
            state = update.model_copy(update=same)
            if state == last:
                continue
            last = state
        yield update


def cancel(
    run_id: Annotated[str | None, typer.Argument(metavar="[RUN]")] = None,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """Cancel the active run, or give up an interrupted one."""
    with connect(endpoint, cell) as client:
        accepted = client.cancel(run_id)
    if as_json:
        emit(accepted)
    else:
        say(f"run {accepted.run_id}: {accepted.message}")


def ack(
    answer: Annotated[str, typer.Option(help="One of the answers that the run offers.")] = "ok",
    question: Annotated[
        int | None, typer.Option(help="The number of the question that is answered.")
    ] = None,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """Answer the question of a waiting run, or acknowledge a fault."""
    with connect(endpoint, cell) as client:
        accepted = client.ack(answer, question=question)
    if as_json:
        emit(accepted)
    else:
        say(accepted.message)
