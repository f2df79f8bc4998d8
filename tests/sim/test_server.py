"""The process around the world: doors that bad input does not break, one world to a file."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cellctl.config import SimulationSection
from cellctl.errors import BadInput, DeviceFault, NotFound
from cellctl.sim.doors import DOORS
from cellctl.sim.endpoint import read_endpoint
from cellctl.sim.launch import connect_or_start, endpoint_file, stop_world
from cellctl.sim.link import Link
from cellctl.sim.wire import HOST, LENGTHS, MAX_BLOB, MAX_HEADER, pack, read_frame
from tests.sim.worlds import world

VERBS = [(door, verb) for door, verbs in DOORS.items() for verb in verbs]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(st.text(max_size=12), inner),
    max_leaves=12,
)
ARGUMENTS = st.sampled_from(
    sorted(
        {
            name
            for verbs in DOORS.values()
            for form, _ in verbs.values()
            for name in form.model_fields
        }
    )
)
HARMLESS = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("server")


@pytest.fixture(scope="module")
def endpoint(directory):
    with world(directory) as running:
        yield running


async def talk(port, *chunks):
    """Send chunks, end the sending side; all replies until the other end closes."""
    reader, writer = await asyncio.open_connection(HOST, port)
    replies = []
    try:
        for chunk in chunks:
            writer.write(chunk)
        with contextlib.suppress(OSError):  # it may have hung up already
            writer.write_eof()
        async with asyncio.timeout(20):
            while True:
                replies.append((await read_frame(reader))[0])
    except (asyncio.IncompleteReadError, ConnectionError):
        return replies
    finally:
        writer.close()


def raw(text, blob=b""):
    return LENGTHS.pack(len(text), len(blob)) + text + blob


async def alive(endpoint):
    link = Link("probe", endpoint.cell)
    reply, _ = await link.request("hello")
    await link.close()
    return reply["arm"] == "ur5"


@pytest.mark.parametrize("door", DOORS)
async def test_unknown_verbs_are_named_and_known_ones_listed(endpoint, door):
    link = Link("curious", getattr(endpoint, door))
    with pytest.raises(NotFound, match=f"door '{door}' knows no verb 'dance'; known: "):
        await link.request("dance")
    await link.close()


async def test_the_doors_are_apart(endpoint):
    """No driver can ask for the truth, and no scorer can move the arm."""
    for port, verb in ((endpoint.cell, "score"), (endpoint.truth, "robot.move")):
        link = Link("curious", port)
        with pytest.raises(NotFound):
            await link.request(verb)
        await link.close()


@pytest.mark.parametrize(
    ("verb", "arguments", "words"),
    [
        ("robot.move", {"waypoints": [[0, 0]]}, "waypoints.0"),
        ("robot.move", {"waypoints": []}, "waypoints"),
        ("robot.read_at", {}, "missing key 'at'"),
        ("robot.read", {"speed": 1}, "unknown key 'speed'"),
        ("wait", {"seconds": -1}, "seconds"),
        ("wait", {"seconds": "soon"}, "seconds"),
        ("camera.picture", {}, "no frame was dequeued"),
        ("projector.show", {"shape": [10, 10]}, "the image is 10 x 10 pixels"),
        ("projector.show", {"shape": [1080, 1920]}, "0 bytes are no uint8 image"),
        ("camera.picture", {"sample": {"name": "", "count": 0}}, "sample.name"),
    ],
)
async def test_malformed_requests_are_told_what_is_wrong(endpoint, verb, arguments, words):
    link = Link("clumsy", endpoint.cell)
    with pytest.raises(BadInput, match=words):
        await link.request(verb, **arguments)
    await link.close()


async def test_a_header_that_is_not_json_is_told_so_and_the_connection_lives_on(endpoint):
    hello = pack({"id": 7, "verb": "hello"})
    replies = await talk(endpoint.cell, raw(b"{no json"), raw(b"[1]"), raw(b"\xff\xfe"), hello)
    assert [reply.get("id") for reply in replies] == [None, None, None, 7]
    assert "not JSON" in replies[0]["error"]["message"]
    assert "must be a JSON object, not list" in replies[1]["error"]["message"]
    assert "not JSON" in replies[2]["error"]["message"]
    assert replies[3]["arm"] == "ur5"


@pytest.mark.parametrize(
    "lengths", [(MAX_HEADER + 1, 0), (2, MAX_BLOB + 1), (2**32 - 1, 2**32 - 1)]
)
async def test_oversized_frames_are_refused_unread(endpoint, lengths):
    (reply,) = await talk(endpoint.cell, LENGTHS.pack(*lengths), b"x" * 100)
    assert "frame refused" in reply["error"]["message"]
    assert await alive(endpoint)


async def test_half_a_frame_and_a_hangup_harm_nobody(endpoint):
    for part in (b"\0", raw(b"{}")[:-1], pack({"id": 1, "verb": "hello"})[:9]):
        assert await talk(endpoint.cell, part) == []
    assert await alive(endpoint)


def test_random_bytes_harm_nobody(endpoint):
    @HARMLESS
    @given(st.sampled_from(list(DOORS)), st.binary(max_size=400))
    def fuzz(door, noise):
        asyncio.run(talk(getattr(endpoint, door), noise))

    fuzz()
    assert asyncio.run(alive(endpoint))


def test_random_requests_get_one_answer_each(endpoint):
    @HARMLESS
    @given(
        st.sampled_from(VERBS),
        st.dictionaries(ARGUMENTS | st.text(max_size=8), JSON, max_size=5),
        st.binary(max_size=50),
    )
    def fuzz(where, arguments, blob):
        door, verb = where
        header = {**arguments, "id": 3, "verb": verb}
        text = json.dumps(header).encode()
        (reply,) = asyncio.run(talk(getattr(endpoint, door), raw(text, blob)))
        assert reply["id"] == 3
        if "error" in reply:
            assert reply["error"]["code"] != "internal", reply

    fuzz()
    assert asyncio.run(alive(endpoint))


def run(*arguments, **options):
    command = [sys.executable, "-m", "cellctl.sim", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, **options
    )


def test_help_is_for_a_person():
    found = run("--help")
    assert found.returncode == 0
    for word in ("serve", "stop", "config"):
        assert word in found.stdout


def test_a_second_world_on_the_same_file_is_refused(endpoint, directory):
    second = run("serve", "--endpoint", str(endpoint_file(directory)))
    assert second.returncode == 3
    assert "runs already" in second.stderr
    assert read_endpoint(endpoint_file(directory)) == endpoint
    assert connect_or_start(SimulationSection(preset="cr"), directory) == endpoint
    with pytest.raises(BadInput, match=r"runs the simulated cell 'cr', seed 0, stepped, not"):
        connect_or_start(SimulationSection(preset="cr", seed=9), directory)


def test_it_says_ready_once_idles_out_and_leaves_no_file(tmp_path):
    file = tmp_path / "world.json"
    found = run("serve", "--endpoint", str(file), "--seed", "4", "--idle-exit-s", "0.3")
    assert found.returncode == 0
    (line,) = found.stdout.splitlines()
    ready = json.loads(line)
    assert ready["ready"] is True
    assert (ready["preset"], ready["seed"], ready["time"]) == ("cr", 4, "stepped")
    assert not file.exists()


async def test_a_connection_keeps_it_alive_and_sigterm_ends_it(tmp_path):
    section = SimulationSection(preset="cr", idle_exit_s=2.0)
    running = await asyncio.to_thread(connect_or_start, section, tmp_path)
    link = Link("holder", running.cell)
    await link.request("hello")
    await asyncio.sleep(2.5)
    await link.request("hello")
    assert await asyncio.to_thread(stop_world, tmp_path)  # although somebody is connected
    with pytest.raises(DeviceFault, match=r"lost|does not answer"):
        await link.request("hello")
    await link.close()
    assert not endpoint_file(tmp_path).exists()
    assert not await asyncio.to_thread(stop_world, tmp_path)


def test_a_killed_world_is_not_taken_for_a_living_one(tmp_path):
    section = SimulationSection(preset="cr", seed=0)
    first = connect_or_start(section, tmp_path)
    os.kill(first.pid, signal.SIGKILL)
    deadline = time.monotonic() + 5
    second = first
    while second == first and time.monotonic() < deadline:
        second = connect_or_start(section, tmp_path)
    try:
        assert second.pid != first.pid
        assert asyncio.run(alive(second))
    finally:
        assert stop_world(tmp_path)


def test_a_world_that_cannot_start_says_why(tmp_path):
    with pytest.raises(DeviceFault, match=r"did not start; its log .* ends: .*invalid choice"):
        connect_or_start(SimulationSection(preset="atlantis"), tmp_path)


def test_a_foreign_endpoint_file_is_refused(tmp_path):
    file = tmp_path / "world.json"
    for text in ("", "[]", "{}", '{"schema": "other/1"}'):
        file.write_text(text)
        with pytest.raises(BadInput, match="not the endpoint file of a simulated cell"):
            read_endpoint(file)
