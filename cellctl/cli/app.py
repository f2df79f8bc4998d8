"""All commands, and what becomes of their errors."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import typer

from cellctl.cli import boards, hosting, offline, reading, reports, running
from cellctl.cli.output import note
from cellctl.cli.output import report as report_error
from cellctl.errors import BadInput, CellctlError

app = typer.Typer(
    name="cellctl",
    help="Calibrate a workcell's robot, camera and projector to each other, unattended.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

for command in (
    hosting.serve,
    running.run,
    reading.status,
    running.watch,
    running.cancel,
    running.ack,
    reading.runs,
    reading.show,
    reading.procedures,
    reading.promote,
    hosting.enable,
    offline.plan,
    offline.solve,
    reports.report,
    offline.check_config,
    hosting.demo,
):
    app.command()(command)
app.add_typer(boards.app, name="board")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code. Expected errors are text, never a traceback."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in arguments
    try:
        code = app(args=arguments, prog_name="cellctl", standalone_mode=False)
    except CellctlError as error:
        return report_error(error, as_json=as_json)
    except typer.TyperException as error:
        return _report_usage(error, as_json)
    except BrokenPipeError:  # the reader of stdout has left; nothing is to be flushed to it at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code if isinstance(code, int) else 0


def _report_usage(error: typer.TyperException, as_json: bool) -> int:
    """A wrong option or argument, or a file that cannot be opened."""
    wrong = BadInput(error.format_message())
    note("Usage: `cellctl --help` and `cellctl COMMAND --help` tell more.")
    return report_error(wrong, as_json=as_json)
