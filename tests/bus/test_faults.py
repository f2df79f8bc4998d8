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
from cellctl.errors import Unreachable
from cellctl.messages import Event, Progress, RunInfo, State
from tests.bus.toy import Daemon, deadline, store_large_calibration

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


COMMAND = """
import sys
from cellctl.cli.app import main
print("ready", flush=True)
sys.exit(main(sys.argv[2:]))
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
        accepted = client.run("count", {"n": 300})
        thread = threading.Thread(target=watch)
        thread.start()
        with deadline(20) as late:
            while client.state().phase == "running" and not late():
                daemon.call(lambda: daemon.server.publish_frame("camera", noise))
                assert slowest_answer(client, 0.05) < 2
        thread.join(10)
        assert not thread.is_alive()
    assert [event.seq for event in events] == list(range(1, 304))


def test_a_client_frozen_before_it_read_its_answers_is_given_up(daemon, client):
    """Ten megabytes wait for it: its link is closed after half a second."""
    store_large_calibration(daemon)
    with frozen_watcher(daemon.endpoint, questions=50):
        assert slowest_answer(client, 3.0) < 2.5
        with deadline(10) as late:
            while daemon.server._answers and not late():
                time.sleep(0.05)


@pytest.mark.skipif("CELLCTL_SOAK" not in os.environ, reason="takes 12 s; set CELLCTL_SOAK")
def test_closing_with_a_frozen_watcher_is_bounded(endpoint, tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    with Daemon(endpoint, tmp_path) as daemon, frozen_watcher(endpoint):
        for _ in range(100):
            daemon.call(lambda: daemon.server.publish_frame("camera", noise))
            time.sleep(0.005)
        start = time.monotonic()
        daemon.stop()
        daemon._thread.join(15)
        assert not daemon._thread.is_alive()
    assert time.monotonic() - start < 15


def boot_of(client: Client) -> str:
    return client.state().boot


def test_a_watcher_outlives_the_daemon(endpoint, tmp_path):
    """Killed in the middle of a run and started again, as one who watches the cell sees it."""
    serve = ("-m", "tests.bus.toy", endpoint, str(tmp_path))
    with program(*serve) as first, Client(endpoint) as client, deadline(30) as late:
        boot, run_id = boot_of(client), client.run("count", {"n": 2000, "pause_s": 0.01}).run_id
        updates = client.watch()
        while not isinstance(next(updates), Event) and not late():
            pass
        first.kill()
        killed = time.monotonic()
        while not isinstance(update := next(updates), Link):
            pass
        assert update == Link(alive=False, boot=boot)
        assert time.monotonic() - killed < 2
        with program(*serve):
            while not isinstance(update := next(updates), Link) and not late():
                pass
            assert update == Link(alive=True, boot=boot_of(client))
            assert client.run_info(run_id).status == "interrupted"
            other = client.run("count", {"n": 1})
            events: list[Event] = []
            while not (events and events[-1].kind == "ended") and not late():
                events += [u for u in [next(updates)] if isinstance(u, Event)]
        updates.close()
    assert {(event.boot, event.run_id) for event in events} == {(other.boot, other.run_id)}
    assert [event.kind for event in events] == ["started", "step", "sample", "ended"]
    assert boot != other.boot


def test_who_waits_gives_up_when_told_to(endpoint, tmp_path):
    """Also the commands: exit code 5, as of a daemon that never was."""
    with (
        program("-m", "tests.bus.toy", endpoint, str(tmp_path)) as daemon,
        Client(endpoint) as client,
    ):
        run_id = client.run("count", {"n": 2000, "pause_s": 0.01}).run_id
        updates = client.watch(run_id, give_up_s=1.0)
        command = ["cellctl", "watch", run_id, "--give-up", "1", "--connect", endpoint]
        with program("-c", COMMAND, *command) as watching:
            assert watching.stdout
            assert watching.stdout.readline(), "it watches"
            next(updates)
            daemon.kill()
            with pytest.raises(Unreachable, match="of toy has not answered for"):
                list(updates)
            assert watching.wait(20) == 5


def test_who_waits_for_a_run_learns_that_the_daemon_was_killed(endpoint, tmp_path):
    serve = ("-m", "tests.bus.toy", endpoint, str(tmp_path))
    with program(*serve) as first, Client(endpoint) as client, deadline(30) as late:
        accepted = client.run("count", {"n": 200, "pause_s": 0.01}, request_id="once-and-again")
        updates = client.watch(accepted.run_id)
        while not isinstance(next(updates), Progress) and not late():
            pass
        first.kill()
        with program(*serve):
            *_, last = updates
            assert isinstance(last, RunInfo)
            assert last.status == "interrupted"
            again = client.run("count", {"n": 200, "pause_s": 0.01}, request_id="once-and-again")
            assert again.replayed
            assert again.run_id == accepted.run_id
            assert again.boot != accepted.boot
            client.resume(accepted.run_id)
            *_, last = client.watch(accepted.run_id)
            assert isinstance(last, RunInfo)
            assert (last.status, last.samples) == ("done", 200)


def test_a_frozen_daemon_is_noticed(endpoint, tmp_path):
    serve = ("-m", "tests.bus.toy", endpoint, str(tmp_path))
    with program(*serve) as process, Client(endpoint) as client, deadline(20) as late:
        updates, boot = client.watch(), boot_of(client)
        assert isinstance(next(updates), State)
        os.kill(process.pid, signal.SIGSTOP)
        while not isinstance(update := next(updates), Link) and not late():
            pass
        assert update == Link(alive=False, boot=boot)
        os.kill(process.pid, signal.SIGCONT)
        while not isinstance(update := next(updates), Link) and not late():
            pass
        assert update == Link(alive=True, boot=boot)
        updates.close()
