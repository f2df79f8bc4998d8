"""The daemon's side of the bus: answers requests and publishes what happens.

Zenoh calls back in threads of its own; they only check the size of a request and hand it to the
event loop. Replies are sent by one thread kept for that, because a reply to a client that has
stopped reading blocks until its link is given up, half a second later. (More threads would block
one after the other on the same link, and for as many times as long.) Publications are dropped
rather than waited for; whoever misses one sees it by its number and asks for it
(`get/events?since=N`).
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self, cast

import structlog
import zenoh

from cellctl.bus.keys import Keys
from cellctl.bus.publications import Publications, encoding
from cellctl.bus.requests import (
    MAX_PAYLOAD_BYTES,
    Request,
    answer,
    error_message,
    internal_error,
    oversized,
)
from cellctl.bus.session import Settings, open_listening, plain
from cellctl.drivers.base import Image
from cellctl.engine import Engine
from cellctl.errors import BadInput, Busy, CellctlError
from cellctl.messages import Error, Message, RobotSnapshot

MAX_WAITING = 64
"""Requests that are being answered at one time; more are refused as busy."""
ANSWER_S = 8.0
"""After this long a request is answered with an error, while the engine goes on with it."""
DRAIN_S = 1.0
"""For how long closing waits for the answers that are under way."""

_log = structlog.get_logger(__name__)


class Server:
    """Serves `engine` as the cell `cell_id` at `endpoint`; `boot` names this daemon process.

    `robot` reads the robot's state for watchers; it is only called while somebody watches.
    Use as an async context manager, or `open` and `close`. All of it belongs to one event loop.
    """

    def __init__(
        self,
        engine: Engine,
        endpoint: str,
        cell_id: str,
        boot: str,
        *,
        robot: Callable[[], Awaitable[RobotSnapshot]] | None = None,
        settings: Settings | None = None,
    ) -> None:
        self._engine = engine
        self._endpoint = endpoint
        self._keys = Keys(cell_id)
        self._live = self._keys.live(boot)
        self._robot = robot
        self._settings = settings
        self._slots = threading.BoundedSemaphore(MAX_WAITING)
        self._answers: set[asyncio.Task[None]] = set()
        self._open = False

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def open(self) -> None:
        """Listen, answer, publish, and only then declare to be alive.

        Raises BadInput when the endpoint is malformed or taken.
        """
        self._loop = asyncio.get_running_loop()
        self._session = await asyncio.to_thread(open_listening, self._endpoint, self._settings)
        self._replies = ThreadPoolExecutor(1, "cellctl-bus-reply")
        self._open = True
        self._publications = Publications(self._session, self._keys, self._engine, self._robot)
        self._queryables = [
            self._session.declare_queryable(key, self._on_query) for key in self._keys.requests
        ]
        self._token = self._session.liveliness().declare_token(self._live)
        _log.info("listening", endpoint=self._endpoint, alive=self._live)

    async def close(self) -> None:
        """Leave the bus. Idempotent; bounded, also when a client has stopped reading (11 s)."""
        if not self._open:
            return
        self._open = False
        self._token.undeclare()
        for queryable in self._queryables:
            await asyncio.to_thread(queryable.undeclare)  # waits for a callback that is running
        await self._publications.close()
        await self._drain()
        await asyncio.to_thread(self._replies.shutdown)
        await asyncio.to_thread(_close_session, self._session)

    def publish_frame(self, camera: str, image: Image) -> None:
        """Offer a camera picture to whoever watches; newest wins. `image` must not change."""
        if self._open:
            self._publications.frame(camera, image)

    # A Zenoh thread from here ...

    def _on_query(self, query: zenoh.Query) -> None:
        if not self._slots.acquire(blocking=False):
            busy = Busy(f"{MAX_WAITING} requests are being answered already; try again")
            _send(query, error_message(busy))
            return
        try:
            self._loop.call_soon_threadsafe(self._accept, query, self._request(query))
        except CellctlError as error:
            self._slots.release()
            _send(query, error_message(error))
        except Exception as error:  # noqa: BLE001 - a query must end, whatever happens
            self._slots.release()
            _log.warning("a query could not be taken", key=str(query.key_expr), reason=str(error))
            _send(query, internal_error(str(query.key_expr), error))

    def _request(self, query: zenoh.Query) -> Request:
        path = str(query.key_expr).removeprefix(self._keys.root + "/")
        payload = query.payload or zenoh.ZBytes(b"")
        if len(payload) > MAX_PAYLOAD_BYTES:
            raise BadInput(oversized(path, len(payload)))
        return Request(path, _parameters(query), payload.to_bytes())

    # ... and the event loop from here.

    def _accept(self, query: zenoh.Query, request: Request) -> None:
        task = self._loop.create_task(self._serve(query, request), name=f"bus {request.path}")
        self._answers.add(task)
        task.add_done_callback(self._answers.discard)

    async def _serve(self, query: zenoh.Query, request: Request) -> None:
        work = asyncio.create_task(answer(self._engine, request))
        sending: Future[None] | None = None
        try:
            done, _ = await asyncio.wait({work}, timeout=ANSWER_S)
            message = work.result() if done else _late(request)
            sending = self._replies.submit(_send, query, message)
            await asyncio.wrap_future(sending)
            await work  # a late one keeps its slot until it has ended
        finally:
            work.cancel()
            if sending is None or sending.cancelled():
                query.drop()
            self._slots.release()

    async def _drain(self) -> None:
        """Let answers end; what then is still under way is cancelled."""
        if self._answers:
            await asyncio.wait(self._answers, timeout=DRAIN_S)
        for task in self._answers:
            task.cancel()
        await asyncio.gather(*self._answers, return_exceptions=True)


def _parameters(query: zenoh.Query) -> dict[str, str]:
    return dict(cast("Iterable[tuple[str, str]]", query.parameters))  # its stub is wrong


def _late(request: Request) -> Error:
    return Error(
        code="internal",
        message=f"{request.path}: no answer within {ANSWER_S:g} s; the daemon goes on with it. "
        "Ask again; a repeated run needs the same request id.",
    )


def _send(query: zenoh.Query, message: Message) -> None:
    """Reply and finish the query; blocks while the client's link is full."""
    with query:
        try:
            if isinstance(message, Error):
                query.reply_err(message.model_dump_json(), encoding=encoding(message))
            else:
                query.reply(query.key_expr, message.model_dump_json(), encoding=encoding(message))
        except zenoh.ZError as error:
            _log.info("a reply could not be sent", reason=plain(error))
        except ValueError as error:  # what the engine returned does not fit into JSON
            broken = internal_error(str(query.key_expr), error)
            query.reply_err(broken.model_dump_json(), encoding=encoding(broken))


def _close_session(session: zenoh.Session) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        _log.warning("the bus did not close cleanly", reason=plain(error))
