"""What can be asked of a daemon, and how it is answered: one literal table, no Zenoh.

Every request is a path below the cell's key, parameters and a small JSON payload; every answer is
a message or an `Error`. Whatever arrives, the answer is one of the two.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import structlog
from pydantic import ValidationError

from cellctl.bus.keys import check_name
from cellctl.engine import Engine
from cellctl.errors import BadInput, CellctlError, NotFound
from cellctl.explain import explain
from cellctl.messages import (
    AckRequest,
    CancelRequest,
    Command,
    Error,
    Message,
    PromoteRequest,
    ResumeRequest,
    RunRequest,
)

MAX_PAYLOAD_BYTES = 64 * 1024
MAX_TEXT = 4000
DEFAULT_RUNS = 50

_log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class Request:
    """`path` is relative to the cell, as `cmd/run/full`."""

    path: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    payload: bytes = b""


async def answer(engine: Engine, request: Request) -> Message:
    """The answer, an `Error` included. Never raises, except when cancelled."""
    try:
        if "*" in request.path:
            raise BadInput(f"{request.path}: a request must name one key, without wildcards")
        if len(request.payload) > MAX_PAYLOAD_BYTES:
            raise BadInput(oversized(request.path, len(request.payload)))
        handler, argument = _route(request.path)
        return await handler(engine, argument, request)
    except CellctlError as error:
        return error_message(error)
    except Exception as error:  # noqa: BLE001 - a caller gets an answer whatever happens
        _log.exception("request failed", path=request.path)
        return internal_error(request.path, error)


def error_message(error: CellctlError) -> Error:
    """As it travels; details that JSON cannot hold travel as text."""
    details = json.loads(json.dumps(error.details, default=str, skipkeys=True))
    return Error(code=error.code, message=error.message[:MAX_TEXT], details=details)


def internal_error(path: str, error: BaseException) -> Error:
    text = f"{path}: internal error, {type(error).__name__}: {error}. The daemon's log says where."
    return Error(code="internal", message=text[:MAX_TEXT])


def oversized(path: str, size: int) -> str:
    return f"{path}: a payload of {size} bytes; {MAX_PAYLOAD_BYTES} are allowed"


async def _state(engine: Engine, _argument: str, _request: Request) -> Message:
    return engine.state()


async def _events(engine: Engine, _argument: str, request: Request) -> Message:
    return engine.events(_count(request, "since", 0))


async def _procedures(engine: Engine, _argument: str, _request: Request) -> Message:
    return engine.procedures()


async def _runs(engine: Engine, _argument: str, request: Request) -> Message:
    """The newest `limit` runs, newest first; results are left to `get/run/{id}`."""
    return await engine.runs(_count(request, "limit", DEFAULT_RUNS))


async def _run(engine: Engine, run_id: str, _request: Request) -> Message:
    return await engine.run_info(check_name(run_id, "run id"))


async def _calibration(engine: Engine, calibration_id: str, _request: Request) -> Message:
    return await engine.calibration(check_name(calibration_id, "calibration id"))


async def _start(engine: Engine, procedure: str, request: Request) -> Message:
    return await engine.start(check_name(procedure, "procedure"), _body(RunRequest, request))


async def _resume(engine: Engine, _argument: str, request: Request) -> Message:
    body = _body(ResumeRequest, request)
    check_name(body.run_id, "run id")
    return await engine.resume(body)


async def _cancel(engine: Engine, _argument: str, request: Request) -> Message:
    body = _body(CancelRequest, request)
    if body.run_id is not None:
        check_name(body.run_id, "run id")
    return await engine.cancel(body)


async def _ack(engine: Engine, _argument: str, request: Request) -> Message:
    return await engine.ack(_body(AckRequest, request))


async def _promote(engine: Engine, _argument: str, request: Request) -> Message:
    body = _body(PromoteRequest, request)
    check_name(body.calibration_id, "calibration id")
    return await engine.promote(body)


Handler = Callable[[Engine, str, Request], Awaitable[Message]]

ROUTES: dict[str, Handler] = {
    "get/state": _state,
    "get/events": _events,
    "get/procedures": _procedures,
    "get/runs": _runs,
    "get/run/{id}": _run,
    "get/calibration/{id}": _calibration,
    "cmd/run/{procedure}": _start,
    "cmd/resume": _resume,
    "cmd/cancel": _cancel,
    "cmd/ack": _ack,
    "cmd/promote": _promote,
}


def _route(path: str) -> tuple[Handler, str]:
    """The handler and the chunk that stands for `{...}`; NotFound names the nearest route."""
    for pattern, handler in ROUTES.items():
        head, brace, _ = pattern.partition("{")
        if path == pattern and not brace:
            return handler, ""
        if brace and path.startswith(head) and "/" not in path[len(head) :]:
            return handler, path[len(head) :]
    close = difflib.get_close_matches(path, ROUTES, n=1)
    hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(ROUTES)}"
    raise NotFound(f"no such request {path[:200]!r}; {hint}")


def _count(request: Request, name: str, default: int) -> int:
    text = request.parameters.get(name, "")
    if not text:
        return default
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise BadInput(f"{request.path}?{name}={text[:40]}: expected a whole number, 0 or more")
    return int(text)


C = TypeVar("C", bound=Command)


def _body(model: type[C], request: Request) -> C:
    """The payload as `model`; nothing at all counts as `{}`."""
    try:
        return model.model_validate_json(request.payload or b"{}")
    except ValidationError as error:
        reasons = explain(error, model, most=5)
        raise BadInput(f"{request.path}: {reasons}"[:MAX_TEXT]) from None
