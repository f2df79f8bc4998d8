"""Fixtures for all tests: nothing that a test starts may outlive it."""

from __future__ import annotations

import asyncio
import functools
import inspect
import os
import signal
import threading
import time
import uuid
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog
from hypothesis import HealthCheck, settings

settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")  # machines are shared: a slow draw is no finding

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As in a shell's background job, and children would inherit it: tests press Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"
GRACE_S = 5.0
TASK_GRACE_S = 1.0


@pytest.fixture(autouse=True)
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves a task, a thread or a child process behind."""
    threads, children = set(threading.enumerate()), _children()
    yield
    deadline = time.monotonic() + GRACE_S
    while (left := _leaked(threads, children)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not left, f"left behind by the test: {', '.join(left)}"


@pytest.fixture(autouse=True)
def logs_go_where_they_went_before() -> Iterator[None]:
    """A command that ran in this process has sent them to a stream that ends with its test."""
    yield
    structlog.reset_defaults()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked `long` are for `make soak-tests`."""
    if "CELLCTL_SOAK" in os.environ:
        return
    skip = pytest.mark.skip(reason="takes long; runs in `make soak-tests`")
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(skip)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Wrap asynchronous tests: a task that is still alive at their end fails them. Before
    pytest-asyncio does, which makes synchronous functions of them."""
    if isinstance(item, pytest.Function) and inspect.iscoroutinefunction(item.obj):
        item.obj = _checked(item.obj)


def _checked(test: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    @functools.wraps(test)
    async def run(*args: Any, **kwargs: Any) -> None:
        before = asyncio.all_tasks()
        await test(*args, **kwargs)
        left = asyncio.all_tasks() - before
        if left:
            _, left = await asyncio.wait(left, timeout=TASK_GRACE_S)
        names = sorted(task.get_name() for task in left)
        assert not left, f"tasks left behind by the test: {', '.join(names)}"

    return run


@pytest.fixture(scope="session", autouse=True)
def no_process_outlives_the_tests() -> Iterator[None]:
    """Fail when a process is left that has cut itself off, as a simulated world does. All that
    descend from here carry a name of ours in their environment."""
    name, value = "CELLCTL_TESTS", uuid.uuid4().hex
    os.environ[name] = value
    yield
    deadline = time.monotonic() + GRACE_S
    while (left := processes_with(value)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not left, f"processes left behind by the tests: {', '.join(left)}"


def processes_with(mark: str) -> list[str]:
    """The processes, but for this one, with `mark` in their environment."""
    found = []
    for directory in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (directory / "environ").read_bytes() and directory.name != str(
                os.getpid()
            ):
                command = (directory / "cmdline").read_bytes().replace(b"\0", b" ")
                found.append(f"{directory.name} ({command.decode(errors='replace')[:200].strip()})")
        except OSError:  # it has ended, or is somebody else's
            continue
    return found


def _leaked(threads: set[threading.Thread], children: set[int]) -> list[str]:
    new_threads = [t.name for t in set(threading.enumerate()) - threads if not _is_pool(t)]
    new_children = [f"process {pid}" for pid in _children() - children]
    return new_threads + new_children


def _is_pool(thread: threading.Thread) -> bool:
    """Idle threads of a loop's default executor, which end with the loop."""
    return thread.name.startswith("asyncio_")


def _children() -> set[int]:
    """Living direct children of this process."""
    found: set[int] = set()
    for task in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        try:
            found.update(int(pid) for pid in task.read_text().split())
        except OSError:
            continue
    return found


@pytest.fixture
def shared_data() -> Path:
    """The folder of real data sets; skips where it is not there."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"real data sets are not on this machine ({SHARED_DATA})")
    return SHARED_DATA
