"""What the daemon says unasked: states, events, progress, robot snapshots, previews.

Nothing here waits for a subscriber. States are complete snapshots, so a lost one does not
matter; events carry numbers, so a lost one is noticed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Self, cast

import structlog
import zenoh

from cellctl.bus.keys import Keys
from cellctl.bus.preview import encode_preview
from cellctl.bus.session import plain
from cellctl.drivers.base import Image
from cellctl.engine import Engine
from cellctl.engine.bulletin import Published
from cellctl.errors import CellctlError
from cellctl.messages import Event, Message, Progress, RobotSnapshot

STATE_S = 0.5
ROBOT_S = 0.1

_log = structlog.get_logger(__name__)


def encoding(message: Message) -> zenoh.Encoding:
    return zenoh.Encoding.APPLICATION_JSON.with_schema(message.schema_name())


class Outage:
    """A context manager around one round of a loop that has to go on: what is raised inside does
    not get out, and the first failure of a row is logged. `over` says that a round succeeded."""

    def __init__(self, what: str) -> None:
        self._what, self._lasts = what, False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if not isinstance(error, Exception):
            return False
        if not self._lasts:
            trace = None if isinstance(error, CellctlError) else error
            _log.warning("publishing fails", what=self._what, reason=str(error), exc_info=trace)
        self._lasts = True
        return True

    def over(self) -> None:
        if self._lasts:
            _log.info("publishing works again", what=self._what)
        self._lasts = False


class Publications:
    """Publishes for one cell until `close`."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        engine: Engine,
        robot: Callable[[], Awaitable[RobotSnapshot]] | None,
    ) -> None:
        self._session, self._keys, self._engine, self._robot = session, keys, engine, robot
        self._state = _declare(session, keys.state, zenoh.Priority.DATA_HIGH)
        self._robot_state = _declare(session, keys.robot, zenoh.Priority.DATA_HIGH)
        self._event = _declare(session, keys.event, zenoh.Priority.INTERACTIVE_LOW)
        self._frames: dict[str, zenoh.Publisher] = {}
        self._pictures: dict[str, Image] = {}
        self._picture_came = asyncio.Event()
        self._unsubscribe = engine.subscribe(self._on_engine)
        self._tasks = [
            asyncio.create_task(work(), name=f"bus {name}")
            for name, work in {
                "state": self._repeat_state,
                "robot": self._repeat_robot,
                "previews": self._send_previews,
            }.items()
        ]
        for task in self._tasks:
            task.add_done_callback(_report_death)

    async def close(self) -> None:
        """Stop publishing; the last state is published once more."""
        self._unsubscribe()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        with Outage("the last state"):
            self._put(self._state, self._engine.state())
        for publisher in (self._state, self._robot_state, self._event, *self._frames.values()):
            publisher.undeclare()

    def frame(self, camera: str, image: Image) -> None:
        """Offer a picture; it is encoded only if somebody watches this camera."""
        if camera not in self._frames:
            priority = zenoh.Priority.DATA_LOW
            self._frames[camera] = _declare(self._session, self._keys.frame(camera), priority)
        if _is_watched(self._frames[camera]):
            self._pictures[camera] = image
            self._picture_came.set()

    def _on_engine(self, message: Published) -> None:
        if isinstance(message, Event):
            self._put(self._event, message)
        elif isinstance(message, Progress):
            self._put_progress(message)
        else:
            self._put(self._state, message)

    def _put(self, publisher: zenoh.Publisher, content: Message | bytes) -> None:
        """A message, or a picture as JPEG."""
        try:
            if isinstance(content, Message):
                publisher.put(content.model_dump_json(), encoding=encoding(content))
            else:
                publisher.put(content, encoding=zenoh.Encoding.IMAGE_JPEG)
        except zenoh.ZError as error:
            _log.warning("a publication failed", key=str(publisher.key_expr), reason=plain(error))

    def _put_progress(self, progress: Progress) -> None:
        try:
            self._session.put(
                self._keys.progress(progress.run_id),
                progress.model_dump_json(),
                encoding=encoding(progress),
                congestion_control=zenoh.CongestionControl.DROP,
            )
        except zenoh.ZError as error:
            _log.warning("a publication failed", run=progress.run_id, reason=plain(error))

    async def _repeat_state(self) -> None:
        outage = Outage("state")
        while True:
            with outage:
                self._put(self._state, self._engine.state())
                outage.over()
            await asyncio.sleep(STATE_S)

    async def _repeat_robot(self) -> None:
        """Robot snapshots while somebody watches; an unreadable robot is logged once."""
        outage = Outage("robot")
        while self._robot is not None:
            await asyncio.sleep(ROBOT_S)
            with outage:
                if _is_watched(self._robot_state):
                    self._put(self._robot_state, await self._robot())
                    outage.over()

    async def _send_previews(self) -> None:
        outage = Outage("previews")
        while True:
            await self._picture_came.wait()
            self._picture_came.clear()
            pictures, self._pictures = self._pictures, {}
            for camera, image in pictures.items():
                with outage:
                    preview = await asyncio.to_thread(encode_preview, image)
                    self._put(self._frames[camera], preview)
                    outage.over()


def _report_death(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()):
        _log.error("publishing has stopped", task=task.get_name(), exc_info=error)


def _declare(session: zenoh.Session, key: str, priority: zenoh.Priority) -> zenoh.Publisher:
    return session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=priority
    )


def _is_watched(publisher: zenoh.Publisher) -> bool:
    """Whether anybody subscribes. The status is an object that is always true."""
    status = cast("zenoh.MatchingStatus", publisher.matching_status)
    return status.matching
