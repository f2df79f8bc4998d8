"""The fixtures against leaks do fire: each test here runs a file of tests that leaves something."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
IMPATIENT = "import tests.conftest\ntests.conftest.GRACE_S = 0.2\n"

TASK = """
import asyncio
LEFT = set()
async def test_leaves_a_task():
    LEFT.add(asyncio.create_task(asyncio.sleep(60), name="the forgotten"))
async def test_ends_what_it_starts():
    await asyncio.create_task(asyncio.sleep(0))
async def test_lets_a_task_end():
    LEFT.add(asyncio.create_task(asyncio.sleep(0.05)))
"""

THREAD = """
import threading
def test_leaves_a_thread():
    threading.Thread(target=threading.Event().wait, args=(1.5,), name="the forgotten").start()
"""

CHILD = """
import subprocess, sys
def test_leaves_a_child():
    global left
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1.5)"])
"""

DETACHED = """
import subprocess, sys
CODE = "import os, time\\nif os.fork(): os._exit(0)\\nos.setsid()\\nprint(os.getpid(), flush=True)"
CODE += "\\nos.close(1)\\nos.close(2)\\ntime.sleep(60)"
def test_leaves_a_process_that_is_no_child():
    subprocess.run([sys.executable, "-c", CODE], check=True)
"""


def run(folder: Path, tests: str, *options: str) -> subprocess.CompletedProcess[str]:
    """These tests, with this project's fixtures and in a process of their own."""
    file = folder / "test_that_leaks.py"
    file.write_text(IMPATIENT + tests)
    ours = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT), "-p", "tests.conftest"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *ours, *options, str(file)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_a_task_that_is_left_fails_the_test(tmp_path):
    done = run(tmp_path, TASK)
    assert done.returncode == 1
    assert "tasks left behind by the test: the forgotten" in done.stdout
    assert "1 failed, 2 passed" in done.stdout


@pytest.mark.parametrize(("tests", "name"), [(THREAD, "the forgotten"), (CHILD, "process ")])
def test_a_thread_or_a_child_that_is_left_fails_the_test(tmp_path, tests, name):
    done = run(tmp_path, tests)
    assert done.returncode == 1
    assert f"left behind by the test: {name}" in done.stdout


def test_a_process_that_has_cut_itself_off_fails_the_session(tmp_path):
    done = run(tmp_path, DETACHED, "--capture=no")
    pid = next(int(word) for word in done.stdout.split() if word.isdecimal())
    os.kill(pid, signal.SIGKILL)
    assert done.returncode == 1
    assert f"processes left behind by the tests: {pid} (" in done.stdout
