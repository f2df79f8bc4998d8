"""Client and server over real sessions."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import cv2
import numpy as np
import pytest
import structlog
import zenoh

from cellctl.bus import queries, server
from cellctl.bus.client import Client
from cellctl.bus.follow import Update
from cellctl.bus.keys import Keys
from cellctl.bus.preview import encode_preview
from cellctl.bus.requests import MAX_PAYLOAD_BYTES
from cellctl.bus.server import Server
from cellctl.bus.session import open_connected, open_listening
from cellctl.errors import (
    BadInput,
    Busy,
    CellctlError,
    Denied,
    DeviceFault,
    NotEnabled,
    NotFound,
    Unreachable,
)
from cellctl.messages import Event, Question, RobotSnapshot, RunInfo, RunRequest, State
from tests.bus.toy import Daemon, deadline, store_large_calibration, toy_engine

KEYS = Keys("toy")


def raw_get(session: zenoh.Session, key: str, payload: bytes | None = None, timeout: float = 5):
    return list(session.get(key, payload=payload, timeout=timeout))


def error_of(reply: zenoh.Reply) -> dict[str, Any]:
    assert reply.err is not None
    assert "application/json;cellctl.Error.v1" in str(reply.err.encoding)
    error: dict[str, Any] = json.loads(reply.err.payload.to_bytes())
    return error


def events_of(updates: Iterable[Update]) -> list[Event]:
    return [update for update in updates if isinstance(update, Event)]


def end_of(updates: Iterable[Update]) -> RunInfo:
    *_, last = updates
    assert isinstance(last, RunInfo)
    return last


def wait_for_question(client: Client) -> Question:
    with deadline(5) as late:
        while not (question := client.state().question) and not late():
            time.sleep(0.01)
    assert question
    return question


def test_the_only_cell_is_found_and_answers(client):
    assert client.cell == "toy"
    assert client.state().cell == "toy"
    assert [p.name for p in client.procedures().procedures] == ["count", "ask", "fault", "move"]


def test_a_run_is_triggered_followed_and_read(client):
    accepted = client.run("count", {"n": 4})
    updates = list(client.watch(accepted.run_id))
    assert end_of(updates).verdict == "pass"
    kinds = [event.kind for event in events_of(updates)]
    assert kinds == ["started", "step", "sample", "sample", "sample", "sample", "ended"]
    info = client.run_info(accepted.run_id)
    assert info.result
    assert info.result["data"]["answer"] == 42.0
    assert [run.run_id for run in client.runs().runs] == [accepted.run_id]
    assert info.calibration_id
    assert client.calibration(info.calibration_id).document["calibration"] == {"camera": [1.0]}
    client.promote(info.calibration_id)
    assert client.calibration().calibration_id == info.calibration_id


def test_the_same_request_id_is_the_same_run(client, endpoint):
    first = client.run("count", {"n": 2}, request_id="morning-shift")
    list(client.watch(first.run_id))
    with Client(endpoint) as other:
        again = other.run("count", {"n": 2}, request_id="morning-shift")
    assert again.run_id == first.run_id
    assert (first.replayed, again.replayed) == (False, True)
    assert len(client.runs().runs) == 1


def test_two_clients_share_one_cell(client, endpoint):
    accepted = client.run("ask")
    with Client(endpoint) as other:
        with pytest.raises(Busy) as caught:
            other.run("count")
        assert caught.value.details == {"active_run": accepted.run_id}
        question = wait_for_question(other)
        assert question.choices == ["yes", "no"]
        with pytest.raises(BadInput, match="no longer asked"):
            other.ack("yes", question=question.id + 1)
        assert other.ack("yes", question=question.id).message == "answered"
    assert end_of(client.watch(accepted.run_id)).status == "done"


def test_errors_come_back_as_themselves(client):
    asks: dict[type[CellctlError], list[Callable[[], object]]] = {
        NotFound: [
            lambda: client.run("nope"),
            lambda: client.run_info("r9"),
            lambda: client.resume("r9"),
            lambda: client.promote("c9"),
            client.cancel,
            client.calibration,
        ],
        BadInput: [client.ack, lambda: client.events(-1), lambda: client.run("count", {"m": 1})],
        NotEnabled: [lambda: client.run("move")],
    }
    for kind, failing in asks.items():
        for ask in failing:
            with pytest.raises(kind):
                ask()


def test_what_a_client_cannot_send_never_leaves_it(client):
    asks: list[Callable[[], object]] = [
        lambda: client.run("count", request_id="short"),
        lambda: client.run("count", speed=101.0),
        lambda: client.run("a/b"),
        lambda: client.run_info("*"),
        lambda: client.calibration("../active"),
        lambda: client.ack("x" * 1001),
    ]
    for ask in asks:
        with pytest.raises(BadInput):
            ask()


def test_cancel_ends_a_run(client):
    accepted = client.run("count", {"n": 1000, "pause_s": 0.01})
    assert client.cancel(accepted.run_id).run_id == accepted.run_id
    assert end_of(client.watch(accepted.run_id)).status == "cancelled"


def test_a_late_joiner_sees_the_whole_run_in_order(client, endpoint):
    accepted = client.run("count", {"n": 40, "pause_s": 0.01})
    with deadline(5) as late:
        while client.run_info(accepted.run_id).samples < 10 and not late():
            time.sleep(0.01)
    with Client(endpoint) as joiner:
        updates = list(joiner.watch(accepted.run_id))
    numbers = [event.data["key"] for event in events_of(updates) if event.kind == "sample"]
    assert numbers == [str(number) for number in range(1, 41)]


@pytest.mark.parametrize("inbox", [1, 3])
def test_what_a_slow_watcher_loses_is_fetched_again(client, monkeypatch, inbox):
    monkeypatch.setattr("cellctl.bus.follow.INBOX", inbox)
    accepted = client.run("count", {"n": 300})
    numbers = []
    for update in client.watch(accepted.run_id):
        if isinstance(update, Event) and update.kind == "sample":
            numbers.append(update.data["key"])
            time.sleep(0.002)
    assert numbers == [str(number) for number in range(1, 301)]


def test_watching_a_cell_begins_with_its_state_and_follows_every_run(client, endpoint):
    list(client.watch(client.run("count").run_id))
    seen: list[Update] = []
    with Client(endpoint) as watcher, deadline(5) as late:
        for update in watcher.watch():
            if not seen:
                second = client.run("count", {"n": 2}).run_id
            seen.append(update)
            if (isinstance(update, Event) and update.kind == "ended") or late():
                break
    assert isinstance(seen[0], State)
    assert {event.run_id for event in events_of(seen)} == {second}


def test_watching_a_run_that_is_not_there(client):
    with pytest.raises(NotFound):
        next(client.watch("r9"))


def test_a_client_can_be_closed_while_it_watches(daemon, endpoint):
    with Client(endpoint) as watcher:
        updates = watcher.watch()
        next(updates)
    updates.close()


@pytest.mark.parametrize(
    "key",
    [
        "cell/*/@v1/get/state",
        "cell/toy/@v1/get/*",
        "cell/toy/@v1/get/**",
        "cell/toy/@v1/cmd/run/*",
        "cell/toy/@v1/cmd/c$*",
    ],
)
def test_wildcards_are_refused(client, daemon, key):
    with open_connected(daemon.endpoint) as session:
        (reply,) = raw_get(session, key, b'{"request_id": "12345678"}')
    assert error_of(reply)["code"] == "bad_request"
    assert "wildcard" in error_of(reply)["message"]
    assert client.runs().runs == []


@pytest.mark.parametrize(
    "payload", [b"", b"{", b"\xff\xfe", b"[]", b"null", b"[" * 50_000, b'{"request_id": 1}']
)
def test_malformed_payloads_are_refused(client, daemon, payload):
    with open_connected(daemon.endpoint) as session:
        (reply,) = raw_get(session, KEYS.request("cmd/run/count"), payload)
    assert error_of(reply)["code"] == "bad_request"
    assert client.state().phase == "idle"


def test_oversized_payloads_are_refused(client, daemon):
    with open_connected(daemon.endpoint) as session:
        (reply,) = raw_get(session, KEYS.request("cmd/ack"), b"x" * (MAX_PAYLOAD_BYTES + 1))
        assert "65536 are allowed" in error_of(reply)["message"]
        (dropped,) = raw_get(session, KEYS.request("cmd/ack"), b"x" * (2 << 20), timeout=0.5)
        assert dropped.err
        assert dropped.err.payload.to_string() == "Timeout"
        (fine,) = raw_get(session, KEYS.request("get/state"))
        assert fine.ok


def test_a_large_answer_arrives_whole(client, daemon):
    store_large_calibration(daemon)
    assert len(client.calibration("large").document["calibration"]) == 200_000


def test_a_daemon_that_keeps_silent_refuses_this_caller(endpoint, monkeypatch):
    monkeypatch.setattr(queries, "PAUSE_S", 0.01)
    with open_listening(endpoint) as daemon:
        token = daemon.liveliness().declare_token(KEYS.live("b1"))
        with Client(endpoint) as client, pytest.raises(Denied, match="refuses get/state"):
            client.state()
        token.undeclare()


def test_a_daemon_that_has_left_is_unreachable(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(queries, "PAUSE_S", 0.01)
    with ExitStack() as stack:
        with Daemon(endpoint, tmp_path):
            client = stack.enter_context(Client(endpoint))
            assert client.state().cell == "toy"
        with pytest.raises(Unreachable, match="cellctl serve"):
            client.state()


def test_a_listener_without_a_cell(endpoint, monkeypatch):
    monkeypatch.setattr(queries, "PAUSE_S", 0.01)
    with (
        open_listening(endpoint),
        pytest.raises(Unreachable, match="no cell lives there"),
        Client(endpoint),
    ):
        pass


def test_another_cell_id_names_those_that_are_there(daemon, monkeypatch):
    monkeypatch.setattr(queries, "PAUSE_S", 0.01)
    with Client(daemon.endpoint, "other") as client, pytest.raises(Unreachable) as caught:
        client.state()
    assert "cells there: toy" in caught.value.message


def test_several_cells_at_one_endpoint_must_be_chosen_from(daemon):
    with open_connected(daemon.endpoint) as session:
        token = session.liveliness().declare_token(Keys("second").live("b2"))
        with pytest.raises(BadInput, match="second, toy"), Client(daemon.endpoint):
            pass
        with Client(daemon.endpoint, "toy") as client:
            assert client.state().cell == "toy"
        token.undeclare()


def test_a_second_daemon_at_the_port_is_told_so(daemon, tmp_path):
    other = Daemon(daemon.endpoint, tmp_path / "other")
    with pytest.raises(BadInput, match="the port is in use"), other:
        pass


def test_a_stuck_request_is_answered_and_keeps_nobody_waiting(client, daemon, monkeypatch):
    monkeypatch.setattr(server, "ANSWER_S", 0.2)
    daemon.wait(daemon.engine._commands.acquire)
    with pytest.raises(CellctlError, match=r"cmd/ack: no answer within 0\.2 s"):
        client.ack()
    assert client.state().phase == "idle"
    daemon.call(daemon.engine._commands.release)
    with deadline(5) as late:
        while daemon.server._answers and not late():
            time.sleep(0.01)


def test_too_many_requests_at_once_are_refused(endpoint, tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MAX_WAITING", 2)
    with (
        Daemon(endpoint, tmp_path) as daemon,
        Client(endpoint) as client,
        ThreadPoolExecutor(2) as pool,
    ):
        daemon.wait(daemon.engine._commands.acquire)
        stuck = [pool.submit(client.promote, "c9") for _ in range(2)]
        with deadline(5) as late:
            while daemon.server._slots._value and not late():
                time.sleep(0.01)
        with pytest.raises(Busy, match="2 requests"):
            client.ack()
        monkeypatch.setattr(queries, "PAUSE_S", 0.01)
        with pytest.raises(Busy, match="2 requests"):
            client.state()
        daemon.call(daemon.engine._commands.release)
        for future in stuck:
            with pytest.raises(NotFound):
                future.result(5)
        assert client.state().phase == "idle"


def test_a_daemon_that_is_busy_for_a_moment_ends_no_watch_and_no_read(client, daemon):
    """All its slots are taken for longer than a poll, and than the first try of a question."""
    slots = daemon.server._slots
    run_id = client.run("count", {"n": 300, "pause_s": 0.01}).run_id
    updates = client.watch(run_id)
    next(updates)
    taken = sum(slots.acquire(blocking=False) for _ in range(server.MAX_WAITING))
    assert taken >= server.MAX_WAITING - 1
    give_back = threading.Timer(0.3, slots.release, (taken,))
    give_back.start()
    assert client.state().active_run == run_id
    give_back.join()
    taken = sum(slots.acquire(blocking=False) for _ in range(server.MAX_WAITING))
    give_back = threading.Timer(1.5, slots.release, (taken,))
    give_back.start()
    assert end_of(updates).status == "done"
    give_back.join()


def test_previews_are_small_and_only_made_for_watchers(daemon):
    image = np.zeros((1080, 1920), np.uint8)
    image[:, 960:] = 200
    got: list[bytes] = []
    came = threading.Event()

    def keep(sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == "image/jpeg"
        got.append(sample.payload.to_bytes())
        came.set()

    daemon.call(lambda: daemon.server.publish_frame("camera", image))
    with (
        open_connected(daemon.endpoint) as session,
        session.declare_subscriber(KEYS.frame("camera"), keep),
        deadline(5) as late,
    ):
        while not came.wait(0.02) and not late():
            daemon.call(lambda: daemon.server.publish_frame("camera", image))
    picture = cv2.imdecode(np.frombuffer(got[0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape[:2] == (360, 640)
    assert abs(int(picture[180, 500]) - 200) < 5
    assert len(got[0]) < 20_000


async def test_robot_snapshots_survive_a_robot_that_cannot_be_read(endpoint, tmp_path):
    reads = 0

    async def read() -> RobotSnapshot:
        nonlocal reads
        reads += 1
        if reads < 3:
            raise DeviceFault("the link is down") if reads == 1 else KeyError("joints")
        return RobotSnapshot(
            t=1.0, joints=[0.0] * 6, position=[0.0] * 3, rvec=[0.0] * 3, standstill_s=1.0
        )

    async with (
        toy_engine(tmp_path) as engine,
        Server(engine, endpoint, "toy", "b1", robot=read),
    ):
        came, loop = asyncio.Event(), asyncio.get_running_loop()
        with open_connected(endpoint) as session:
            assert reads == 0
            hear = lambda sample: loop.call_soon_threadsafe(came.set)  # noqa: E731
            with session.declare_subscriber(KEYS.robot, hear):
                await asyncio.wait_for(came.wait(), 5)
    assert reads >= 3


def test_publishing_goes_on_after_any_error_and_says_so_once(daemon, client, monkeypatch):
    """Two rounds of state, of the robot and of pictures fail; the third is told."""
    monkeypatch.setattr("cellctl.bus.publications.STATE_S", 0.02)
    publications, failures = daemon.server._publications, dict.fromkeys(("state", "encode"), 2)

    def failing(name, function):
        def call(*arguments):
            if failures[name] > 0:
                failures[name] -= 1
                raise OSError(5, "Input/output error")
            return function(*arguments)

        return call

    state = failing("state", daemon.engine.state)
    encode = failing("encode", encode_preview)
    monkeypatch.setattr("cellctl.bus.publications.encode_preview", encode)
    heard: set[str] = set()
    image = np.zeros((48, 64), np.uint8)
    with (
        structlog.testing.capture_logs() as logs,
        open_connected(daemon.endpoint) as session,
        session.declare_subscriber(KEYS.frame("camera"), lambda _: heard.add("picture")),
        session.declare_subscriber(KEYS.state, lambda _: heard.add("state")),
        deadline(5) as late,
    ):
        monkeypatch.setattr(daemon.engine, "state", state)
        while failures["state"] and not late():
            time.sleep(0.01)
        heard.discard("state")
        while heard != {"picture", "state"} and not late():
            daemon.call(lambda: daemon.server.publish_frame("camera", image))
            time.sleep(0.01)
    living = {task.get_name() for task in publications._tasks if not task.done()}
    assert living == {"bus state", "bus previews"}, "and there is no robot to be told of"
    failed = [line["what"] for line in logs if line["event"] == "publishing fails"]
    assert sorted(failed) == ["previews", "state"]


def test_a_trigger_reads_as_documented(client):
    """The wire form that docs/bus.md shows and examples/trigger.py sends."""
    request = RunRequest(client="me", request_id="12345678", params={"n": 1})
    assert json.loads(request.model_dump_json()) == {
        "v": 1,
        "client": "me",
        "request_id": "12345678",
        "params": {"n": 1},
        "speed": 100.0,
        "step": False,
    }
