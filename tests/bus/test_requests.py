"""Whatever arrives, the answer is a message or a typed error."""

from __future__ import annotations

import json

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from cellctl.bus.requests import (
    MAX_PAYLOAD_BYTES,
    MAX_TEXT,
    ROUTES,
    Request,
    answer,
    error_message,
)
from cellctl.errors import BY_CODE, BadInput, DeviceFault
from cellctl.messages import Error, Message
from tests.bus.toy import Daemon

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)
COMMANDS = st.fixed_dictionaries(
    {},
    optional={
        "v": JSON,
        "client": JSON,
        "request_id": JSON | st.just("12345678"),
        "params": JSON,
        "speed": JSON,
        "run_id": JSON,
        "calibration_id": JSON,
        "answer": JSON,
    },
)
PAYLOADS = st.binary(max_size=64) | st.one_of(JSON, COMMANDS).map(lambda v: json.dumps(v).encode())
CHUNKS = st.sampled_from(["get", "cmd", "run", "state", "events", "..", "*", "cancel", "ack", ""])
PATHS = st.lists(CHUNKS | st.text(max_size=6), max_size=4).map("/".join) | st.sampled_from(
    [route.replace("{procedure}", "count").replace("{id}", "r0001") for route in ROUTES]
)
PARAMETERS = st.dictionaries(st.sampled_from(["since", "limit", "x"]), st.text(max_size=6))


def ask(daemon: Daemon, path: str, payload: object = b"", **parameters: str) -> Message:
    body = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    return daemon.wait(lambda: answer(daemon.engine, Request(path, parameters, body)))


@settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # one daemon takes them all
)
@given(PATHS, PARAMETERS, PAYLOADS)
def test_any_request_gets_an_answer_that_can_be_sent(daemon, path, parameters, payload):
    message = ask(daemon, path, payload, **parameters)
    assert json.loads(message.model_dump_json())["v"] == 1
    if isinstance(message, Error):
        assert message.code in BY_CODE
        assert message.code != "internal", message
        assert 0 < len(message.message) <= MAX_TEXT


@pytest.mark.parametrize(
    ("path", "payload", "code", "text"),
    [
        ("get/stat", b"", "not_found", "did you mean get/state"),
        ("get/run/a/b", b"", "not_found", "no such request"),
        ("get/run/*", b"", "bad_request", "wildcards"),
        ("**", b"", "bad_request", "wildcards"),
        ("get/run/..", b"", "bad_request", "is not a name"),
        ("cmd/run/count", b"", "bad_request", "missing key 'request_id'"),
        ("cmd/run/count", b"{", "bad_request", "Invalid JSON"),
        ("cmd/run/count", {"request_id": "1234567"}, "bad_request", "at least 8 characters"),
        (
            "cmd/run/count",
            {"v": 2, "request_id": "12345678"},
            "bad_request",
            "v: Input should be 1",
        ),
        ("cmd/resume", {"run_id": "../r1"}, "bad_request", "is not a name"),
        ("cmd/cancel", {"run_id": "a/b"}, "bad_request", "is not a name"),
        ("cmd/promote", {"calibration_id": "/etc"}, "bad_request", "is not a name"),
        ("cmd/ack", b" " * (MAX_PAYLOAD_BYTES + 1), "bad_request", "65536 are allowed"),
    ],
)
def test_errors_say_what_is_wrong(daemon, path, payload, code, text):
    error = ask(daemon, path, payload)
    assert isinstance(error, Error)
    assert error.code == code
    assert text in error.message


@pytest.mark.parametrize("since", ["-1", "1.5", "x", "٣", "9" * 13])
def test_since_must_be_a_number(daemon, since):
    error = ask(daemon, "get/events", since=since)
    assert isinstance(error, Error)
    assert "since" in error.message


def test_an_unforeseen_exception_is_internal_and_logged(daemon, monkeypatch, capsys):
    def broken() -> None:
        raise KeyError("nobody foresaw this")

    monkeypatch.setattr(daemon.engine, "procedures", broken)
    error = ask(daemon, "get/procedures")
    assert isinstance(error, Error)
    assert error.code == "internal"
    assert "nobody foresaw this" in error.message
    assert "Traceback" in capsys.readouterr().out


def test_runs_are_newest_first_and_without_results(daemon, client):
    started = []
    for _ in range(3):
        started.append(client.run("count", {"n": 0}).run_id)
        list(client.watch(started[-1]))
    assert client.run_info(started[-1]).result
    runs = client.runs(limit=2).runs
    assert [run.run_id for run in runs] == started[:0:-1]
    assert all(run.result is None for run in runs)


def test_details_that_json_cannot_hold_travel_as_text():
    error = error_message(DeviceFault("lost", when=complex(1, 2), where={("a", 1): 2, "b": 3}))
    assert error.details == {"when": "(1+2j)", "where": {"b": 3}}
    assert len(error_message(BadInput("x" * 10_000)).message) == MAX_TEXT
