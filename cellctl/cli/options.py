"""Options that several commands share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from cellctl.bus.client import Client
from cellctl.errors import BadInput
from cellctl.local import DEFAULT_ENDPOINT

Connect = Annotated[
    str, typer.Option("--connect", envvar="CELLCTL_CONNECT", help="Where the daemon listens.")
]
CellId = Annotated[
    str | None,
    typer.Option("--cell", envvar="CELLCTL_CELL", help="Which cell, if several answer there."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
GiveUp = Annotated[
    float | None,
    typer.Option(
        "--give-up", metavar="SECONDS", min=1.0, help="Wait no longer for a daemon that is gone."
    ),
]
ConfigFile = Annotated[Path, typer.Argument(help="The cell's TOML file.", metavar="CONFIG")]

HERE = DEFAULT_ENDPOINT


def connect(endpoint: str, cell: str | None) -> Client:
    """A client, to be entered."""
    return Client(endpoint, cell)


def parse_params(texts: list[str]) -> dict[str, Any]:
    """`k=v` pairs: values are JSON where they parse as JSON, else text.

    Raises BadInput for a pair without `=`, an empty or a repeated name.
    """
    params: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise BadInput(f"--param {text!r}: expected name=value, as --param views=20")
        if name in params:
            raise BadInput(f"--param {name!r} is given twice")
        params[name] = _value(value)
    return params


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text
