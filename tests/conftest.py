"""Fixtures for all tests: nothing that a test starts may outlive it."""

from __future__ import annotations

import asyncio
import functools
import os
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"
GRACE_S = 5.0


@pytest.fixture(autouse=True)
def no_leaks() -> Iterator[None]:
    """Fail a test that leaves a task, a thread or a child process behind."""
    threads, children = set(threading.enumerate()), _children()
    yield
    deadline = time.monotonic() + GRACE_S
    while (left := _leaked(threads, children)) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not left, f"left behind by the test: {', '.join(left)}"


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    """Wrap asynchronous tests: a task that is still alive at their end fails them."""
    if asyncio.iscoroutinefunction(pyfuncitem.obj):
        pyfuncitem.obj = _checked(pyfuncitem.obj)
    return (yield)


def _checked(test: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    @functools.wraps(test)
    async def run(*args: Any, **kwargs: Any) -> None:
        before = asyncio.all_tasks()
        await test(*args, **kwargs)
        await asyncio.sleep(0)
        left = [task.get_name() for task in asyncio.all_tasks() - before if not task.done()]
        assert not left, f"tasks left behind by the test: {', '.join(left)}"

    return run


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
