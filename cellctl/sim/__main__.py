"""`python -m cellctl.sim`: serve a simulated cell, stop it, or print its config."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from dataclasses import asdict
from pathlib import Path

import structlog

from cellctl.errors import CellctlError
from cellctl.sim.cell_config import cell_document, to_toml
from cellctl.sim.endpoint import Endpoint, only_one
from cellctl.sim.launch import stop_endpoint
from cellctl.sim.presets import PRESETS
from cellctl.sim.server import Server, Settings


def main() -> int:
    """Exit code: 0, or the error's own."""
    arguments = _parser().parse_args()
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(file=sys.stderr))
    try:
        code: int = arguments.run(arguments)
    except CellctlError as error:
        sys.stderr.write(f"{error.message}\n")
        return error.exit_code
    return code


def _serve(arguments: argparse.Namespace) -> int:
    settings = Settings(
        preset=arguments.cell,
        seed=arguments.seed,
        time=arguments.time,
        endpoint_file=arguments.endpoint,
        idle_exit_s=arguments.idle_exit_s,
    )
    with only_one(settings.endpoint_file):
        asyncio.run(_run(settings))
    return 0


async def _run(settings: Settings) -> None:
    await Server(settings).run(_say_ready)


def _say_ready(endpoint: Endpoint) -> None:
    sys.stdout.write(json.dumps({"ready": True, **asdict(endpoint)}) + "\n")
    sys.stdout.flush()


def _config(arguments: argparse.Namespace) -> int:
    sys.stdout.write(to_toml(cell_document(PRESETS[arguments.cell], arguments.seed)))
    return 0


def _stop(arguments: argparse.Namespace) -> int:
    stopped = stop_endpoint(arguments.endpoint)
    sys.stderr.write(
        "stopped\n" if stopped else f"no simulated cell runs on {arguments.endpoint}\n"
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m cellctl.sim", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    serve = commands.add_parser("serve", help="serve a cell until it is stopped or left alone")
    _which_cell(serve)
    serve.add_argument("--time", choices=("stepped", "paced"), default="stepped")
    _endpoint(serve)
    serve.add_argument("--idle-exit-s", type=float, default=1800.0, metavar="SECONDS")
    serve.set_defaults(run=_serve)

    config = commands.add_parser("config", help="print the TOML of a cell")
    _which_cell(config)
    config.set_defaults(run=_config)

    stop = commands.add_parser("stop", help="stop the cell that serves on an endpoint file")
    _endpoint(stop)
    stop.set_defaults(run=_stop)
    return parser


def _which_cell(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--cell", choices=sorted(PRESETS), default="cr", help="preset")
    parser.add_argument("--seed", type=_seed, default=0, help="draws what is true in the cell")


def _endpoint(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--endpoint",
        type=Path,
        default=Path("world.json"),
        metavar="FILE",
        help="where ports and pid are written",
    )


def _seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError("a seed is 0 or more")
    return seed


if __name__ == "__main__":
    sys.exit(main())
