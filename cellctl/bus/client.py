"""The other side of the bus, for the command line and for Python programs. Synchronous.

    with Client() as cell:
        accepted = cell.run("full")
        for update in cell.watch(accepted.run_id):
            print(update)

A daemon's errors come back as the same classes of `cellctl.errors`. No answer at all is told
apart: `Denied` when a daemon is alive but keeps silent to this caller, else `Unreachable`.
"""

from __future__ import annotations

import socket
import uuid
from collections.abc import Generator
from contextlib import ExitStack
from typing import Any, Self, TypeVar

from pydantic import ValidationError

from cellctl.bus.follow import Follower, Update
from cellctl.bus.keys import Keys, check_name
from cellctl.bus.queries import Queries, only_cell
from cellctl.bus.session import Settings, open_connected
from cellctl.errors import BadInput
from cellctl.explain import explain
from cellctl.local import DEFAULT_ENDPOINT, user
from cellctl.messages import (
    Accepted,
    AckRequest,
    CalibrationInfo,
    CancelRequest,
    Command,
    Events,
    Procedures,
    PromoteRequest,
    ResumeRequest,
    RunAccepted,
    RunInfo,
    RunRequest,
    Runs,
    State,
)


class Client:
    """A connection to the cell `cell` at `endpoint`; without `cell`, to the only one there.

    A context manager. Entering it raises Unreachable, or BadInput when `endpoint` or `cell` is
    malformed or several cells live there. Every query raises Unreachable, Denied, or what the
    daemon answered. `label` (user@host by default) is for the daemon's audit trail.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        cell: str | None = None,
        *,
        label: str | None = None,
        settings: Settings | None = None,
    ) -> None:
        self.endpoint = endpoint
        self.label = (label or _who())[:64]
        self._wanted = cell
        self._settings = settings
        self._open = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            session = opening.enter_context(open_connected(self.endpoint, self._settings))
            self.keys = Keys(self._wanted or only_cell(session, self.endpoint))
            self._queries = Queries(session, self.keys, self.endpoint)
            self._session = session
            self._open = opening.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def cell(self) -> str:
        return self.keys.cell

    def state(self) -> State:
        return self._queries.ask("get/state", State)

    def events(self, since: int = 0) -> Events:
        """The events after number `since` that the daemon still remembers."""
        return self._queries.ask(f"get/events?since={since}", Events)

    def procedures(self) -> Procedures:
        return self._queries.ask("get/procedures", Procedures)

    def runs(self, limit: int = 50) -> Runs:
        """The newest runs, newest first, without their results."""
        return self._queries.ask(f"get/runs?limit={limit}", Runs)

    def run_info(self, run_id: str) -> RunInfo:
        return self._queries.ask(f"get/run/{check_name(run_id, 'run id')}", RunInfo)

    def calibration(self, calibration_id: str = "active") -> CalibrationInfo:
        check_name(calibration_id, "calibration id")
        return self._queries.ask(f"get/calibration/{calibration_id}", CalibrationInfo)

    def run(
        self,
        procedure: str,
        params: dict[str, Any] | None = None,
        *,
        request_id: str | None = None,
        speed: float = 100.0,
        step: bool = False,
    ) -> RunAccepted:
        """Trigger a procedure. The same `request_id` again gives the same run, not another one.

        `speed` is the percentage of the configured speed; `step` asks before every motion.
        """
        check_name(procedure, "procedure")
        request = _made(
            RunRequest,
            client=self.label,
            request_id=request_id or uuid.uuid4().hex,
            params=params or {},
            speed=speed,
            step=step,
        )
        return self._queries.ask(f"cmd/run/{procedure}", RunAccepted, request)

    def resume(self, run_id: str) -> RunAccepted:
        request = _made(ResumeRequest, client=self.label, run_id=run_id)
        return self._queries.ask("cmd/resume", RunAccepted, request)

    def cancel(self, run_id: str | None = None) -> Accepted:
        """Cancel the active run, or abandon an interrupted one. Returns before it has ended."""
        request = _made(CancelRequest, client=self.label, run_id=run_id)
        return self._queries.ask("cmd/cancel", Accepted, request)

    def ack(self, answer: str = "ok", *, question: int | None = None) -> Accepted:
        """Acknowledge a fault, or answer the question of a waiting run.

        With the id of the `question` an answer that comes late is refused; a question that offers
        a choice has to be named by it.
        """
        request = _made(AckRequest, client=self.label, answer=answer, question=question)
        return self._queries.ask("cmd/ack", Accepted, request)

    def promote(self, calibration_id: str, *, despite_failed_verdict: bool = False) -> Accepted:
        """Make a calibration the active one; one that failed its verdict only if that is said."""
        request = _made(
            PromoteRequest,
            client=self.label,
            calibration_id=calibration_id,
            despite_failed_verdict=despite_failed_verdict,
        )
        return self._queries.ask("cmd/promote", Accepted, request)

    def watch(
        self, run_id: str | None = None, *, give_up_s: float | None = None
    ) -> Generator[Update]:
        """What happens from now on, or to one run until it ends; outlives the daemon.

        With `run_id` the last update is the RunInfo of the run, which has then ended or been
        interrupted; without, the iterator goes on until it is closed. With `give_up_s` it raises
        Unreachable when the daemon has been silent for so long.
        """
        if run_id is not None:
            self.run_info(run_id)  # NotFound at once, not at the first poll
        with Follower(self._session, self.keys, self._queries, run_id, give_up_s) as follower:
            yield from follower


def _who() -> str:
    """user@host, for the audit trail."""
    return f"{user()}@{socket.gethostname()}"


C = TypeVar("C", bound=Command)


def _made(model: type[C], **fields: Any) -> C:
    """A request; BadInput names the field that cannot be sent."""
    try:
        return model(**fields)
    except ValidationError as error:
        raise BadInput(explain(error, model)) from None
