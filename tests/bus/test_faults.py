"""What happens when a process at one end dies or freezes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from cellctl.bus.client import Client
from cellctl.bus.follow import Link
from cellctl.messages import Event, State
from tests.bus.toy import Daemon, deadline

ROOT = Path(__file__).parents[2]

WATCHER = """
import sys, zenoh
from cellctl.bus.session import open_connected
with open_connected(sys.argv[1]) as session:
    with session.declare_subscriber("cell/toy/@v1/**", lambda sample: None):
        for _ in range(int(sys.argv[2])):
            session.get("cell/toy/@v1/get/calibration/large", lambda reply: None, timeout=60)
        print("ready", flush=True)
        sys.stdin.read()
"""


@contextmanager
def program(*argv: str) -> Iterator[subprocess.Popen[str]]:
    """A Python program that has said "ready"; it is killed at the end, whatever its state."""
    process = subprocess.Popen(
        [sys.executable, *argv],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert process.stdin
    assert process.stdout
    try:
        for line in process.stdout:
            if line.startswith("ready"):
                break
        yield process
    finally:
        process.kill()
        process.wait(10)
        process.stdin.close()
        process.stdout.close()


@contextmanager
def frozen_watcher(endpoint: str, questions: int = 0) -> Iterator[None]:
    with program("-c", WATCHER, endpoint, str(questions)) as process:
        os.kill(process.pid, signal.SIGSTOP)
        yield


def slowest_answer(client: Client, seconds: float) -> float:
    slowest, end = 0.0, time.monotonic() + seconds
    while (start := time.monotonic()) < end:
        client.state()
        slowest = max(slowest, time.monotonic() - start)
    return slowest


def test_a_frozen_watcher_stalls_neither_the_daemon_nor_others(daemon, client):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    events: list[Event] = []

    def watch() -> None:
        with Client(daemon.endpoint) as other:
            events.extend(u for u in other.watch(accepted.run_id) if isinstance(u, Event))

    with frozen_watcher(daemon.endpoint):
        accepted = client.run("count", {"n": 1000, "pause_s": 0.001})
        thread = threading.Thread(target=watch)
        thread.start()
        with deadline(20) as late:
            while client.state().phase == "running" and not late():
                daemon.call(lambda: daemon.server.publish_frame("camera", noise))
                assert slowest_answer(client, 0.05) < 0.5
        thread.join(10)
        assert not thread.is_alive()
    assert [event.seq for event in events] == list(range(1, 1003))


def test_a_client_frozen_before_it_read_its_answers_is_given_up(daemon, client):
    """Ten megabytes wait for it: its link is closed after half a second."""
    with frozen_watcher(daemon.endpoint, questions=50):
        assert slowest_answer(client, 3.0) < 1.5
        with deadline(10) as late:
            while daemon.server._answers and not late():
                time.sleep(0.05)


@pytest.mark.skipif("CELLCTL_SOAK" not in os.environ, reason="takes 12 s; set CELLCTL_SOAK")
def test_closing_with_a_frozen_watcher_is_bounded(endpoint):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    with Daemon(endpoint) as daemon, frozen_watcher(endpoint):
        for _ in range(100):
            daemon.call(lambda: daemon.server.publish_frame("camera", noise))
            time.sleep(0.005)
        start = time.monotonic()
        daemon.call(daemon._stop.set)
        daemon._thread.join(15)
        assert not daemon._thread.is_alive()
    assert time.monotonic() - start < 15


def test_a_watcher_outlives_the_daemon(endpoint):
    """Killed without warning and started again, as the watcher sees it."""
    module = ("-m", "tests.bus.toy", endpoint, "toy")
    seen: list[object] = []
    with program(*module, "boot-1") as first, Client(endpoint) as client:
        client.run("count", {"n": 1000, "pause_s": 0.01})
        updates = client.watch()
        with deadline(20) as late:
            while sum(isinstance(u, Event) for u in seen) < 3 and not late():
                seen.append(next(updates))
        first.kill()
        killed = time.monotonic()
        while not isinstance(update := next(updates), Link):
            pass
        assert update == Link(alive=False, boot="boot-1")
        assert time.monotonic() - killed < 1.0
        with program(*module, "boot-2"), deadline(20) as late:
            while not isinstance(update := next(updates), Link) and not late():
                pass
            assert update == Link(alive=True, boot="boot-2")
            accepted = client.run("count", {"n": 1})
            events: list[Event] = []
            while not (events and events[-1].kind == "run_ended") and not late():
                events += [u for u in [next(updates)] if isinstance(u, Event)]
        updates.close()
    assert {event.boot for event in events} == {"boot-2"}
    assert [event.kind for event in events] == ["run_started", "sample", "run_ended"]
    assert accepted.boot == "boot-2"


def test_a_frozen_daemon_is_noticed(endpoint):
    module = ("-m", "tests.bus.toy", endpoint, "toy")
    with program(*module, "boot-1") as process, Client(endpoint) as client, deadline(20) as late:
        updates = client.watch()
        assert isinstance(next(updates), State)
        os.kill(process.pid, signal.SIGSTOP)
        while not isinstance(update := next(updates), Link) and not late():
            pass
        assert update == Link(alive=False, boot="boot-1")
        os.kill(process.pid, signal.SIGCONT)
        while not isinstance(update := next(updates), Link) and not late():
            pass
        assert update == Link(alive=True, boot="boot-1")
        updates.close()
