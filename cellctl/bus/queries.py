"""One query, one answer, or an error that says which kind of silence it was."""

from __future__ import annotations

import time
from typing import TypeVar

import zenoh
from pydantic import ValidationError

from cellctl.bus.keys import LIVE_ANYWHERE, Keys, parse_live
from cellctl.bus.session import plain
from cellctl.errors import BY_CODE, BadInput, Busy, CellctlError, Denied, Unreachable
from cellctl.messages import Command, Error, Message

ANSWER_S = 10.0
TRIES = 4
PAUSE_S = 0.15
"""Pause after the first silent try, growing by itself; a link that has just come back needs it."""

M = TypeVar("M", bound=Message)


class Queries:
    """Queries to the cell of `keys` over an open session; `endpoint` is named in errors."""

    def __init__(self, session: zenoh.Session, keys: Keys, endpoint: str) -> None:
        self._session, self._keys, self._endpoint = session, keys, endpoint

    def ask(self, path: str, model: type[M], request: Command | None = None) -> M:
        """The answer to `path`; the daemon's error, Denied or Unreachable is raised. What only
        reads is asked again when the daemon has too much to answer."""
        for attempt in range(TRIES):
            last = attempt == TRIES - 1
            try:
                message = self._once(path, model, request, ANSWER_S)
            except Busy:
                if request is not None or last:
                    raise
                message = None
            if message is not None:
                return message
            time.sleep(PAUSE_S * (attempt + 1))
        raise self._silence(path)

    def poll(self, path: str, model: type[M], timeout_s: float = 1.0) -> M | None:
        """One short try; None when nobody answered, or the daemon has too much to answer. Its
        other errors are raised."""
        try:
            return self._once(path, model, None, timeout_s)
        except (Unreachable, Busy):
            return None

    def _once(
        self, path: str, model: type[M], request: Command | None, timeout_s: float
    ) -> M | None:
        payload = request.model_dump_json() if request else None
        try:
            replies = self._session.get(
                self._keys.request(path), payload=payload, timeout=timeout_s
            )
        except zenoh.ZError as error:
            raise Unreachable(f"{path} cannot be asked: {plain(error)}") from None
        for reply in replies:
            if reply.ok is not None:
                return _parsed(model, reply.ok.payload.to_bytes(), path)
            raise self._failure(reply.err, path, timeout_s)
        return None

    def _failure(self, error: zenoh.ReplyError | None, path: str, timeout_s: float) -> CellctlError:
        """Only the encoding tells a daemon's error from one that Zenoh made up."""
        if error is not None and Error.schema_name() in str(error.encoding):
            return as_exception(_parsed(Error, error.payload.to_bytes(), path))
        reason = error.payload.to_bytes()[:200].decode(errors="replace") if error else "no reason"
        return Unreachable(
            f"{path}: no answer from {self._endpoint} within {timeout_s:g} s ({reason}). The "
            "daemon lives but is stuck, or the link is.",
            endpoint=self._endpoint,
        )

    def _silence(self, path: str) -> CellctlError:
        """Zero replies: a daemon that is gone and one that refuses look the same until asked."""
        cell, endpoint = self._keys.cell, self._endpoint
        if living(self._session, self._keys.live_anyone):
            return Denied(
                f"cell {cell!r} at {endpoint} is alive but refuses {path.partition('?')[0]} to "
                "this identity. Ask its owner for access.",
                endpoint=endpoint,
            )
        others = sorted({other for other, _ in living(self._session)})
        return Unreachable(
            f"cell {cell!r} does not answer at {endpoint}; "
            + (f"cells there: {', '.join(others)}. " if others else "no cell lives there. ")
            + "Look at the daemon's log, or start it with `cellctl serve`.",
            endpoint=endpoint,
            cells=others,
        )


def only_cell(session: zenoh.Session, endpoint: str) -> str:
    """The id of the one living cell; a daemon that has just opened its port is waited for.

    Raises Unreachable when there is none, BadInput that lists them when there are several.
    """
    cells: list[str] = []
    for attempt in range(TRIES):
        if cells := sorted({cell for cell, _ in living(session)}):
            break
        time.sleep(PAUSE_S * (attempt + 1))
    if len(cells) > 1:
        raise BadInput(
            f"several cells answer at {endpoint}: {', '.join(cells)}. Choose one with --cell.",
            cells=cells,
        )
    if not cells:
        raise Unreachable(
            f"something listens at {endpoint}, but no cell lives there. Is that the port of "
            "`cellctl serve`?",
            endpoint=endpoint,
        )
    return cells[0]


def living(session: zenoh.Session, key: str = LIVE_ANYWHERE) -> list[tuple[str, str]]:
    """(cell, boot) of every daemon that is alive."""
    replies = session.liveliness().get(key, timeout=1.0)
    return [parse_live(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None]


def as_exception(error: Error) -> CellctlError:
    """The exception that the daemon raised; an unknown code is a CellctlError."""
    exception = BY_CODE.get(error.code, CellctlError)(error.message)
    exception.details = error.details
    return exception


def _parsed(model: type[M], payload: bytes, path: str) -> M:
    try:
        return model.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise CellctlError(
            f"{path}: the answer is not a {model.schema_name()}: {first['msg']}. Is the daemon of "
            "another version?"
        ) from None
