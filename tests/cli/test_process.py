"""The command as a process: what only a process can show."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

from cellctl.bus.client import Client
from tests.bus.toy import Daemon, deadline

ROOT = Path(__file__).parents[2]
HEAVY = {"cv2", "matplotlib", "numpy", "reportlab", "scipy", "sklearn", "structlog"}


def start(daemon: Daemon, *arguments: str, stderr: int = subprocess.PIPE) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "cellctl", *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "CELLCTL_CONNECT": daemon.endpoint},
    )


def wait_for_a_run(daemon: Daemon) -> str:
    with Client(daemon.endpoint) as client, deadline(20) as late:
        while not (run_id := client.state().active_run) and not late():
            time.sleep(0.02)
    assert run_id
    return run_id


def test_stdout_holds_the_json_and_nothing_else(daemon):
    process = start(daemon, "run", "count", "--json")
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0
    assert json.loads(out)["status"] == "done"
    assert "step counting" in err


def test_an_error_is_no_traceback(daemon):
    process = start(daemon, "run", "nope", "--json")
    out, err = process.communicate(timeout=30)
    assert process.returncode == 6
    assert json.loads(out)["error"]["code"] == "not_found"
    assert err.startswith("error: no procedure 'nope'")


def test_ctrl_c_detaches_and_the_run_goes_on(daemon):
    process = start(daemon, "run", "count", "--param", "n=2000", "--param", "pause_s=0.02")
    run_id = wait_for_a_run(daemon)
    assert process.stderr
    assert "started" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 130
    assert out == ""
    assert f"cellctl cancel {run_id}" in err
    assert f"cellctl watch {run_id}" in err
    assert wait_for_a_run(daemon) == run_id


def test_a_watcher_ends_cleanly_with_ctrl_c(daemon):
    process = start(daemon, "watch", "--json")
    assert process.stdout
    first = json.loads(process.stdout.readline())
    assert (first["type"], first["phase"]) == ("State", "idle")
    with Client(daemon.endpoint) as client:
        run_id = client.run("count", {"n": 2}).run_id
    kinds = []
    for line in process.stdout:
        update = json.loads(line)
        if update["type"] == "Event":
            kinds.append((update["kind"], update["run_id"]))
        if kinds and kinds[-1][0] == "ended":
            break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=10)
    assert (process.returncode, err) == (0, "")
    assert kinds == [(kind, run_id) for kind in ("started", "step", "sample", "sample", "ended")]


def test_a_bar_on_a_terminal_leaves_stdout_alone(daemon):
    terminal, slave = pty.openpty()
    with Client(daemon.endpoint) as client:
        run_id = client.run("count", {"n": 30, "pause_s": 0.05}).run_id
    process = start(daemon, "watch", run_id, stderr=slave)
    os.close(slave)
    out, _ = process.communicate(timeout=30)
    shown = os.read(terminal, 1 << 16).decode()
    os.close(terminal)
    assert process.returncode == 0
    assert len([line for line in out.splitlines() if " sample " in line]) == 30
    assert "/30" in shown
    assert " sample " not in shown


def test_talking_to_a_daemon_imports_nothing_heavy():
    code = "import sys, cellctl.cli.app; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    assert not HEAVY & set(done.stdout.split())


def test_the_example_triggers_and_prints_the_result(daemon):
    done = subprocess.run(
        [sys.executable, "examples/trigger.py", daemon.endpoint, "toy", "count"],
        cwd=ROOT,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert '"answer": 42.0' in done.stdout
    assert "pass" in done.stdout
