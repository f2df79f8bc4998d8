"""stdout is for results, stderr for everything else."""

from __future__ import annotations

import json
import math
import sys
from typing import Any

from pydantic import BaseModel
from rich.console import Console

from cellctl.errors import CellctlError

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def emit(value: BaseModel | dict[str, Any]) -> None:
    """Print one JSON object, on one line. Numbers that are not finite become null."""
    if isinstance(value, BaseModel):
        text = value.model_dump_json()
    else:
        text = json.dumps(_finite(value), allow_nan=False, default=str)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """Tell the person something that is not the result."""
    err.print(text, markup=False, soft_wrap=True)


def say(text: str) -> None:
    """A line of the result."""
    out.print(text, markup=False, soft_wrap=True)


def report(error: CellctlError, *, as_json: bool) -> int:
    """Tell what is wrong; returns the exit code."""
    err.print("[bold red]error:[/] ", end="")
    note(error.message)
    if as_json:
        body = {"code": error.code, "message": error.message, "details": error.details}
        emit({"error": body})
    return error.exit_code


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
