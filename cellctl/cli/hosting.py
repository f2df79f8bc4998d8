"""Commands that run a cell on this machine, or give it leave to move."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from cellctl.cli import words
from cellctl.cli.display import ProgressBar
from cellctl.cli.logs import log_to_stderr
from cellctl.cli.options import AsJson, ConfigFile
from cellctl.cli.output import emit, say
from cellctl.cli.results import print_data, print_table, print_table_two, print_verdict
from cellctl.errors import BadInput


def serve(config: ConfigFile) -> int:
    """Run the daemon of a cell until SIGTERM or Ctrl-C."""
    log_to_stderr()
    from cellctl.config import load_config
    from cellctl.daemon import serve_forever

    return serve_forever(load_config(config))


def enable(
    duration: Annotated[str, typer.Option("--for", help="As 8h, 90m or 1h30m.")] = "8h",
    config: Annotated[
        Path | None, typer.Option(help="The cell's TOML file, which says where its data are.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Permit motion for a while. Only on the cell's own machine, by who may write its data."""
    from cellctl import permission

    directory = _data_dir(config)
    grant = permission.enable(directory, permission.parse_duration(duration))
    if as_json:
        emit({"data_dir": str(directory), "until": grant.until, "by": grant.by})
    else:
        say(f"motion is enabled until {words.clock(grant.until)} ({directory})")


def _data_dir(config: Path | None) -> Path:
    """Of the config; else CELLCTL_DATA; else where every cell's data are by default, which has to
    be where a daemon has kept some: a permission that no daemon reads would only look like one."""
    from cellctl.config import CellSection, load_config
    from cellctl.store.store import LOCK

    if config is not None:
        return load_config(config).data_dir()
    if given := os.environ.get("CELLCTL_DATA"):
        return Path(given).expanduser()
    default = Path(CellSection.model_fields["data_dir"].default).expanduser()
    if not (default / LOCK).exists():
        raise BadInput(
            f"no daemon keeps its data in {default}; say which cell is meant: "
            "`cellctl enable --config CELL.toml`, or type what `cellctl status` shows"
        )
    return default


def _exit_once(number: int, _: object) -> None:
    """So that what the demo has started is ended; a second signal does not hurry it."""
    signal.signal(number, signal.SIG_IGN)
    raise SystemExit(128 + number)


def demo(
    cell: Annotated[str, typer.Option(help="Which simulated cell: cr or ir.")] = "cr",
    seed: Annotated[int, typer.Option(min=0, help="Draws the cell's true geometry.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Calibrate a simulated cell, unattended, and score it against its truth."""
    log_to_stderr()
    from cellctl.demo import run_demo

    signal.signal(signal.SIGTERM, _exit_once)
    with ProgressBar() as bar:
        result = run_demo(cell, seed, follow=bar.show)
    if as_json:
        emit(result)
    else:
        print_verdict(result["final"]["verdict"], result["final"].get("reasons"))
        print_table_two(result["table"])
        print_table("The published pipeline, stage by stage", result["stages"])
        print_data({k: v for k, v in result.items() if k not in ("table", "stages", "paper")})
    return 0 if result["final"]["verdict"] == "pass" else 1
