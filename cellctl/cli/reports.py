"""`cellctl report`: writes the report of a run, of a daemon or of a folder from anywhere."""

from __future__ import annotations

import os
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from cellctl.cli.logs import log_to_stderr
from cellctl.cli.options import HERE, AsJson, CellId, Connect, connect
from cellctl.cli.output import emit, note, say
from cellctl.cli.reading import newest_run
from cellctl.errors import NotFound, Unreachable

LATEST = "latest"


def report(
    run: Annotated[
        str, typer.Argument(metavar="RUN", help="A run's id, its folder, or `latest`.")
    ] = LATEST,
    open_it: Annotated[bool, typer.Option("--open", help="Show it in a browser.")] = False,
    as_json: AsJson = False,
    endpoint: Connect = HERE,
    cell: CellId = None,
) -> None:
    """Write the report of a run, one HTML file that opens offline, and print its path."""
    log_to_stderr()
    from cellctl.report.page import write_report

    path = write_report(find_folder(run, endpoint, cell))
    if as_json:
        emit({"run": path.parent.parent.name, "report": str(path)})
    else:
        say(str(path))
    if open_it and not webbrowser.open(path.as_uri()):
        note("no browser could be started here; open the file yourself")


def find_folder(run: str, endpoint: str, cell: str | None) -> Path:
    """The folder of a run: a path, or an id (or `latest`) that a running daemon knows, else one
    in CELLCTL_DATA. NotFound and Unreachable say what was tried."""
    folder = Path(run).expanduser()
    if folder.is_dir():
        return folder.absolute()
    if os.sep in run:
        raise NotFound(f"{folder}: there is no such folder")
    try:
        with connect(endpoint, cell) as client:
            run_id = newest_run(client) if run == LATEST else run
            return Path(client.run_info(run_id).directory)
    except Unreachable as error:
        if (found := _without_a_daemon(run)) is not None:
            return found
        raise Unreachable(
            f"{error.message}; without a daemon, name the run's folder, or set CELLCTL_DATA"
        ) from None


def _without_a_daemon(run: str) -> Path | None:
    """As the store keeps runs; their ids sort by time."""
    data = os.environ.get("CELLCTL_DATA")
    if not data:
        return None
    runs = Path(data).expanduser() / "runs"
    known = sorted(path for path in runs.glob("*") if (path / "run.json").exists())
    if run == LATEST:
        return known[-1] if known else None
    return next((path for path in known if path.name == run), None)
