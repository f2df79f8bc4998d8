"""What the engine publishes: numbered events, of which the newest are kept, and snapshots."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import structlog

from cellctl.messages import Event, Events, Progress, State

KEPT = 1000

Published = State | Event | Progress
Callback = Callable[[Published], None]

log = structlog.get_logger(__name__)


class Bulletin:
    """Numbers events within one `boot` and hands everything to who subscribed."""

    def __init__(self, boot: str) -> None:
        self.boot = boot
        self.seq = 0
        self._kept: deque[Event] = deque(maxlen=KEPT)
        self._callbacks: list[Callback] = []

    def subscribe(self, callback: Callback) -> Callable[[], None]:
        """Call `callback` with everything from now on; returns what ends that."""
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback) if callback in self._callbacks else None

    def event(self, kind: str, run_id: str | None = None, **data: Any) -> None:
        """Number, keep and publish an event."""
        self.seq += 1
        event = Event(
            boot=self.boot,
            seq=self.seq,
            kind=kind,
            wall_time=time.time(),
            run_id=run_id,
            data=data,
        )
        self._kept.append(event)
        self.publish(event)

    def since(self, seq: int) -> Events:
        """The events after `seq` that are still kept; a gap shows in their numbers."""
        return Events(boot=self.boot, events=[event for event in self._kept if event.seq > seq])

    def publish(self, message: Published) -> None:
        """Hand over a message. A subscriber that raises is logged; the run goes on."""
        for callback in list(self._callbacks):
            try:
                callback(message)
            except Exception:
                log.exception("a subscriber failed", message=type(message).__name__)
