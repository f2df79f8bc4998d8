"""Follow a cell or a run, whatever happens to the link or to the daemon.

Subscriptions bring news at once; a poll each second brings what they lost, notices a daemon that
hangs, and finds the end of a run after a restart. Events come in order and once.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Self

import zenoh
from pydantic import ValidationError

from cellctl.bus.keys import Keys, parse_live
from cellctl.bus.queries import Queries
from cellctl.errors import Unreachable
from cellctl.messages import Event, Events, Progress, RunInfo, State

POLL_S = 1.0
SOON_S = 0.05
SILENT_POLLS = 3
INBOX = 1000

GOES_ON = ("running", "waiting")


@dataclass(frozen=True)
class Link:
    """The daemon has gone (`alive` False) or come back; `boot` is the process."""

    alive: bool
    boot: str


Update = State | Event | Progress | RunInfo | Link


class Follower:
    """Iterates over updates of one run, or of the whole cell when `run_id` is None.

    Raises Unreachable when the daemon has been silent for `give_up_s`; None waits for ever.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        queries: Queries,
        run_id: str | None,
        give_up_s: float | None = None,
    ) -> None:
        self._session, self._keys, self._queries, self._run_id = session, keys, queries, run_id
        self._give_up_s = give_up_s
        self._heard = time.monotonic()
        self._inbox: queue.Queue[zenoh.Sample] = queue.Queue(INBOX)
        self._subscriptions = ExitStack()
        self._boot: str | None = None
        self._alive = True
        self._met = False
        self._silent = 0
        self._seen = 0
        self._progress: Progress | None = None
        self._poll_at = 0.0
        self._ended = False

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            for key in self._keys_to_hear():
                opening.enter_context(self._session.declare_subscriber(key, self._put))
            live, alive = self._keys.live_anyone, self._session.liveliness()
            opening.enter_context(alive.declare_subscriber(live, self._put, history=True))
            self._subscriptions = opening.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriptions.close()

    def __iter__(self) -> Iterator[Update]:
        while not self._ended:
            wait = self._poll_at - time.monotonic()
            if wait <= 0:
                self._poll_at = time.monotonic() + POLL_S
                yield from self._poll()
                continue
            with suppress(queue.Empty):
                yield from self._take(self._inbox.get(timeout=wait))

    def _keys_to_hear(self) -> tuple[str, ...]:
        if self._run_id is not None:
            return self._keys.event, self._keys.progress(self._run_id)
        return self._keys.event, self._keys.progress_of_all, self._keys.state

    def _put(self, sample: zenoh.Sample) -> None:
        """In a Zenoh thread. What does not fit is found again by the poll."""
        with suppress(queue.Full):
            self._inbox.put_nowait(sample)

    def _poll_soon(self) -> None:
        self._poll_at = min(self._poll_at, time.monotonic() + SOON_S)

    def _take(self, sample: zenoh.Sample) -> Iterator[Update]:
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        if "/live/" in key:
            yield from self._on_token(parse_live(key)[1], sample.kind == zenoh.SampleKind.PUT)
            return
        with suppress(ValidationError):  # of another version: the poll will complain
            if key == self._keys.event:
                yield from self._on_event(Event.model_validate_json(payload))
            elif key == self._keys.state:
                yield State.model_validate_json(payload)
            else:
                yield from self._on_progress(Progress.model_validate_json(payload))

    def _on_token(self, boot: str, alive: bool) -> Iterator[Update]:
        if alive:
            yield from self._on_alive(boot)
        elif boot == self._boot and self._alive:
            self._alive = False
            yield Link(alive=False, boot=boot)

    def _on_alive(self, boot: str) -> Iterator[Update]:
        """The daemon process `boot` is there; another one than before starts its numbers anew."""
        known, was_alive = self._boot, self._alive
        self._boot, self._alive, self._silent = boot, True, 0
        self._heard = time.monotonic()
        if boot != known:
            self._seen = 0
            self._poll_soon()
        if known is not None and (boot != known or not was_alive):
            yield Link(alive=True, boot=boot)

    def _on_event(self, event: Event) -> Iterator[Update]:
        if event.boot != self._boot or event.seq > self._seen + 1:
            self._poll_soon()  # the poll brings it, and those before it
            return
        if event.seq <= self._seen:
            return
        self._seen = event.seq
        if self._run_id is None:
            yield event
        elif event.run_id == self._run_id:
            if event.kind == "ended":
                self._poll_soon()
            yield event

    def _on_progress(self, progress: Progress | None) -> Iterator[Update]:
        if progress is not None and progress != self._progress:
            self._progress = progress
            yield progress

    def _poll(self) -> Iterator[Update]:
        boot, since = self._boot, self._seen
        run = self._queries.poll(f"get/run/{self._run_id}", RunInfo) if self._run_id else None
        events = self._queries.poll(f"get/events?since={since}", Events)
        if events is None:
            yield from self._on_silence()
            return
        yield from self._on_alive(events.boot)
        if boot is not None and boot != events.boot:
            return  # `since` was a number of another process; the next poll is soon
        if not self._met:
            yield from self._meet(events)
        for event in events.events:
            self._seen = max(self._seen, event.seq - 1)  # what the daemon has forgotten
            yield from self._on_event(event)
        if run is not None:
            yield from self._on_run(run)

    def _meet(self, events: Events) -> Iterator[Update]:
        """The first answer: of a whole cell the past is of no interest, only how it stands."""
        self._met = True
        if self._run_id is None:
            self._seen = max((event.seq for event in events.events), default=0)
            if state := self._queries.poll("get/state", State):
                yield state

    def _on_run(self, run: RunInfo) -> Iterator[Update]:
        yield from self._on_progress(run.progress)
        if run.status not in GOES_ON:
            self._ended = True
            yield run

    def _on_silence(self) -> Iterator[Update]:
        silence_s = time.monotonic() - self._heard
        if self._give_up_s is not None and silence_s >= self._give_up_s:
            raise Unreachable(
                f"the daemon of {self._keys.cell} has not answered for {silence_s:.0f} s; look at "
                "its log, and start it again with `cellctl serve`"
            )
        self._silent += 1
        if self._silent >= SILENT_POLLS and self._alive and self._boot is not None:
            self._alive = False
            yield Link(alive=False, boot=self._boot)
