"""The supervisor of child processes: results, errors, deadlines, deaths, ends."""

from __future__ import annotations

import asyncio
import os
import signal
import time

import numpy as np
import pytest
import structlog

from cellctl.errors import DeviceFault, SolveError
from cellctl.worker import child as worker
from cellctl.worker.child import CallFailed, Child
from tests.core import functions
from tests.core.processes import alive, python, said


@pytest.fixture
async def child():
    async with Child("solver") as child:
        yield child


async def until(condition, seconds=5.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come true"
        await asyncio.sleep(0.01)


async def test_one_process_serves_many_calls(child):
    pids = {await child.call(functions.pid, timeout_s=20) for _ in range(3)}
    assert pids == {child.pid}
    assert await child.call(functions.add, 0.1, 0.2, timeout_s=20) == 0.1 + 0.2


async def test_images_arrive_whole_and_writable(child):
    image = np.arange(1080 * 1920, dtype=np.uint8).reshape(1080, 1920) % 100
    fortran = np.asfortranarray(image[:10, :20])
    doubled = await child.call(functions.scale, image, 2, timeout_s=20)
    assert np.array_equal(doubled, image * 2)
    doubled[0, 0] = 1
    back = await child.call(functions.echo, {"f": fortran, "cut": image[::2, ::3]}, timeout_s=20)
    assert np.array_equal(back["f"], fortran)
    assert np.array_equal(back["cut"], image[::2, ::3])


async def test_one_thread_for_opencv_and_blas(child):
    assert await child.call(functions.threads, timeout_s=20) == {"opencv": 1, "blas": "1"}


async def test_deliberate_errors_come_back_as_themselves(child):
    with pytest.raises(SolveError, match="too few") as caught:
        await child.call(functions.raise_solve_error, timeout_s=20)
    assert caught.value.details == {"views": 3, "needed": 4}
    assert await child.call(functions.pid, timeout_s=20) == child.pid


async def test_other_exceptions_carry_and_log_the_childs_traceback(child):
    with structlog.testing.capture_logs() as logs, pytest.raises(CallFailed) as caught:
        await child.call(functions.divide_by_zero, timeout_s=20)
    assert "tests.core.functions.divide_by_zero failed: ZeroDivisionError" in caught.value.message
    assert "return 1 / 0" in caught.value.details["traceback"]
    assert any("return 1 / 0" in line.get("traceback", "") for line in logs)


@pytest.mark.parametrize("function", [functions.unpicklable, functions.raise_unpicklable])
async def test_what_cannot_be_sent_back_is_an_error_and_not_a_death(child, function):
    with pytest.raises(CallFailed, match="pickle"):
        await child.call(function, timeout_s=20)
    assert await child.call(functions.add, 1, 1, timeout_s=20) == 2


async def test_what_cannot_be_sent_is_refused_before_anything_starts(child):
    with pytest.raises(Exception, match="pickle"):
        await child.call(lambda: 1, timeout_s=20)
    assert child.pid is None


async def test_a_missed_deadline_names_function_and_deadline_and_gives_a_fresh_process(child):
    first = await child.call(functions.pid, timeout_s=20)
    with pytest.raises(DeviceFault, match=r"functions\.sleep did not end within 0\.2 s"):
        await child.call(functions.sleep, 30, timeout_s=0.2)
    assert not alive(first)
    assert await child.call(functions.pid, timeout_s=20) != first


@pytest.mark.parametrize(
    ("function", "args", "words"),
    [
        (functions.die_by, (signal.SIGKILL,), "died by SIGKILL"),
        (functions.segfault, (), "died by SIGSEGV"),
        (functions.exit_with, (7,), "exited with code 7"),
    ],
)
async def test_a_death_is_named_and_survived(child, function, args, words):
    with pytest.raises(DeviceFault, match=words) as caught:
        await child.call(function, *args, timeout_s=20)
    assert function.__name__ in caught.value.message
    assert await child.call(functions.add, 1, 1, timeout_s=20) == 2


async def test_a_death_while_idle_costs_no_call(child):
    first = await child.call(functions.pid, timeout_s=20)
    os.kill(first, signal.SIGKILL)
    reapable = os.WEXITED | os.WNOHANG | os.WNOWAIT
    await until(lambda: os.waitid(os.P_PID, first, reapable) is not None)
    assert await child.call(functions.pid, timeout_s=20) != first


async def test_it_is_not_restarted_forever(child, monkeypatch):
    monkeypatch.setattr(worker, "DEATHS_WINDOW_S", 60.0)
    for _ in range(worker.DEATHS_ALLOWED):
        with pytest.raises(DeviceFault, match="exited with code 3"):
            await child.call(functions.exit_with, 3, timeout_s=20)
    with pytest.raises(DeviceFault, match="died 5 times within 60 s"):
        await child.call(functions.pid, timeout_s=20)
    monkeypatch.setattr(worker, "DEATHS_WINDOW_S", 0.0)
    assert await child.call(functions.add, 1, 1, timeout_s=20) == 2


async def test_prints_do_not_harm_the_reply_and_reach_the_log_line_by_line(child):
    with structlog.testing.capture_logs() as logs:
        assert await child.call(functions.chatter, 100, timeout_s=20) == "quiet"
        await until(lambda: any("descriptor 1" in line["event"] for line in logs))
    said = [line["event"] for line in logs if line.get("child") == "solver"]
    assert [f"line {n}" for n in range(100)] == [line for line in said if line.startswith("line")]
    assert "to stderr" in said


async def test_stdin_belongs_to_the_requests(child):
    assert await child.call(functions.read_stdin, timeout_s=20) == ""
    assert await child.call(functions.add, 1, 1, timeout_s=20) == 2


async def test_calls_take_turns(child):
    await child.start()
    started = time.monotonic()
    replies = await asyncio.gather(
        *(child.call(functions.sleep, 0.15, timeout_s=20) for _ in range(3))
    )
    assert replies == ["slept"] * 3
    assert time.monotonic() - started >= 0.45


async def test_a_cancelled_call_kills_the_child_and_one_that_waits_its_turn_does_not(
    child, tmp_path
):
    marker = tmp_path / "started"
    first = asyncio.create_task(
        child.call(functions.touch_and_sleep, str(marker), 30, timeout_s=60)
    )
    await until(lambda: marker.exists() and marker.read_text())
    second = asyncio.create_task(child.call(functions.pid, timeout_s=20))
    await asyncio.sleep(0)
    second.cancel()
    await asyncio.wait({second})
    assert second.cancelled()
    assert alive(int(marker.read_text()))
    first.cancel()
    await asyncio.wait({first}, timeout=5)
    assert first.cancelled()
    assert not alive(int(marker.read_text()))
    assert await child.call(functions.add, 1, 1, timeout_s=20) == 2


async def test_close_ends_a_call_in_flight_and_is_idempotent(tmp_path):
    child = Child("solver")
    marker = tmp_path / "started"
    call = asyncio.create_task(child.call(functions.touch_and_sleep, str(marker), 30, timeout_s=60))
    await until(lambda: marker.exists() and marker.read_text())
    await asyncio.gather(child.close(), child.close())
    with pytest.raises(DeviceFault, match="was closed during"):
        await call
    assert not alive(int(marker.read_text()))
    await child.close()
    with pytest.raises(DeviceFault, match="is closed"):
        await child.call(functions.pid, timeout_s=20)


async def test_a_child_that_cannot_start_says_why():
    async with Child("solver", preload=["no_such_module"]) as child:
        with pytest.raises(DeviceFault, match=r"exited with code 1 during its start.*no_such_m"):
            await child.call(functions.pid, timeout_s=20)


async def test_the_loop_goes_on_while_the_child_computes(child):
    await child.start()
    call = asyncio.create_task(child.call(functions.sleep, 0.3, timeout_s=20))
    ticks = 0
    while not call.done():
        await asyncio.sleep(0.01)
        ticks += 1
    assert ticks > 10


PARENT = """
import asyncio, sys
import structlog
from cellctl.worker.child import Child
from tests.core import functions

async def main():
    async with Child("solver") as child:
        await child.start()
        print(child.pid, flush=True)
        await child.call(getattr(functions, sys.argv[1]), *eval(sys.argv[2]), timeout_s=60)

structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
asyncio.run(main())
"""


@pytest.mark.parametrize("call", [("sleep", "(60,)"), ("hold_the_lock", "()")])
def test_it_ends_with_a_parent_that_is_killed(call):
    with python("-c", PARENT, *call) as parent:
        pid = int(said(parent))
        time.sleep(0.2)
        assert alive(pid)
        parent.kill()
    deadline = time.monotonic() + 5
    while alive(pid):
        assert time.monotonic() < deadline, "the child outlived its parent"
        time.sleep(0.01)
