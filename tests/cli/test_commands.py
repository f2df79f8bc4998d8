"""Commands against a living toy daemon: what is said, where, and with which exit code."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from cellctl import permission
from cellctl.bus.session import free_endpoint
from cellctl.cli.running import _complete
from tests.bus.toy import deadline
from tests.cli.conftest import Cellctl


def started(cellctl: Cellctl, *arguments: str) -> str:
    said = cellctl("run", *arguments, "--detach")
    assert said.code == 0
    return said.out.strip()


def wait_for(cellctl: Cellctl, phase: str) -> None:
    with deadline(5) as late:
        while cellctl("status", "--json").json["phase"] != phase and not late():
            time.sleep(0.01)


def test_a_run_that_passes(cellctl):
    said = cellctl("run", "count", "--param", "n=2")
    assert said.code == 0
    assert said.out.startswith("PASS: count (run 2")
    assert "cellctl promote cal-" in said.out
    assert "step counting" in said.err
    assert "step counting" not in said.out


def test_a_run_that_fails_its_verdict(cellctl):
    said = cellctl("run", "count", "--param", "verdict=fail")
    assert said.code == 1
    assert said.out.startswith("FAIL: count")
    assert "  - it was asked to fail" in said.out
    assert "promote" not in said.out


def test_a_run_as_json_is_one_object(cellctl):
    said = cellctl("run", "count", "--param", "n=2", "--json")
    assert said.code == 0
    assert said.json["verdict"] == "pass"
    assert said.json["samples"] == 2
    assert said.json["result"]["data"]["answer"] == 42.0


def test_a_fault_is_told_shown_and_acknowledged(cellctl):
    said = cellctl("run", "fault")
    assert said.code == 1
    assert said.out.startswith("INTERRUPTED: fault")
    assert "the toy's spring is broken" in said.out
    assert "cellctl run --resume" in said.out
    status = cellctl("status")
    assert status.code == 0
    assert "FAULT: the toy's spring is broken" in status.out
    assert "cellctl ack" in status.out
    assert cellctl("ack").code == 0
    assert cellctl("status", "--json").json["phase"] == "idle"


def test_a_question_is_shown_and_answered(cellctl):
    run_id = started(cellctl, "ask")
    wait_for(cellctl, "waiting")
    status = cellctl("status").out
    assert "is the board on?" in status
    question = cellctl("status", "--json").json["question"]["id"]
    number = ("--question", str(question))
    assert f"cellctl ack --answer yes --question {question}" in status
    wrong = cellctl("ack", "--answer", "perhaps", *number)
    assert (wrong.code, wrong.out) == (2, "")
    assert "choose one of: yes, no" in wrong.err
    unnamed = cellctl("ack", "--answer", "yes")
    assert unnamed.code == 2
    assert f"cellctl ack --answer yes --question {question}" in unnamed.err
    late = cellctl("ack", "--answer", "yes", "--question", str(question - 1))
    assert (late.code, "no longer asked" in late.err) == (2, True)
    assert cellctl("ack", "--answer", "yes", *number).code == 0
    assert cellctl("watch", run_id).code == 0
    assert cellctl("ack").code == 2


def test_a_stepped_run_asks_at_every_checkpoint(cellctl):
    run_id = started(cellctl, "count", "--step", "--speed", "50")
    wait_for(cellctl, "waiting")
    question = cellctl("status", "--json").json["question"]["id"]
    command = f"cellctl ack --answer 'go on without asking' --question {question}"
    assert command in cellctl("status").out
    assert cellctl("ack", "--answer", "cancel", "--question", str(question)).code == 0
    said = cellctl("watch", run_id)
    assert said.code == 1
    assert "CANCELLED" in said.out


def test_cancel_and_busy(cellctl):
    run_id = started(cellctl, "count", "--param", "n=2000", "--param", "pause_s=0.05")
    busy = cellctl("run", "count", "--json")
    assert busy.code == 3
    assert busy.json["error"]["code"] == "busy"
    assert busy.json["error"]["details"] == {"active_run": run_id}
    assert run_id in cellctl("cancel").out
    assert cellctl("watch", run_id).out.splitlines()[-3].startswith("CANCELLED")
    assert cellctl("cancel").code == 6


def test_every_line_of_a_watch_as_json_says_its_type(cellctl):
    run_id = started(cellctl, "count", "--param", "n=2")
    said = cellctl("watch", run_id, "--json")
    lines = [json.loads(line) for line in said.out.splitlines()]
    assert {"Event", "RunInfo"} <= {line["type"] for line in lines}
    assert (lines[-1]["type"], lines[-1]["run_id"]) == ("RunInfo", run_id)
    assert said.code == 0


def test_an_interrupted_run_is_resumed_or_given_up(cellctl):
    cellctl("run", "fault")
    cellctl("ack")
    run_id = cellctl("runs", "--json").json["runs"][0]["run_id"]
    assert cellctl("run", "count", "--resume", run_id).code == 2
    assert cellctl("run", "--resume", run_id, "--param", "n=1").code == 2
    assert cellctl("run", "fault", "--resume", run_id).code == 1
    cellctl("ack")
    assert "abandoned" in cellctl("cancel", run_id).out
    assert cellctl("run", "--resume", run_id).code == 2
    assert cellctl("show", run_id).out.startswith("ABANDONED")


def test_the_same_request_id_does_not_run_twice(cellctl):
    first = cellctl("run", "count", "--request-id", "shift-2-of-may", "--json").json
    again = cellctl("run", "count", "--request-id", "shift-2-of-may", "--json")
    assert again.json["run_id"] == first["run_id"]
    assert "was started before" in again.err
    assert len(cellctl("runs", "--json").json["runs"]) == 1


def test_a_calibration_is_shown_and_promoted(cellctl):
    assert cellctl("show", "active").code == 6
    calibration = cellctl("run", "count", "--json").json["calibration_id"]
    assert "not active" in cellctl("show", calibration).out
    assert cellctl("promote", calibration).code == 0
    assert cellctl("show", "active", "--json").json["calibration_id"] == calibration
    assert calibration in cellctl("status").out
    failed = cellctl("run", "count", "--param", "verdict=fail", "--json").json["calibration_id"]
    assert cellctl("promote", failed).code == 2
    assert cellctl("promote", failed, "--despite-failed-verdict").code == 0


def test_motion_needs_permission_given_on_this_machine(cellctl, tmp_path, monkeypatch):
    refused = cellctl("run", "move")
    assert refused.code == 4
    command = f"CELLCTL_DATA={tmp_path} cellctl enable --for 8h"
    assert refused.err.rstrip().endswith(command)
    assert "".join(command.split()) in "".join(cellctl("status").out.split())
    assert cellctl("run", "move", "--json").json["error"]["details"] == {"command": command}
    monkeypatch.setenv("CELLCTL_DATA", str(tmp_path))
    assert cellctl("enable", "--for", "10m").code == 0
    assert permission.Permission(tmp_path).until() == pytest.approx(time.time() + 600, abs=30)
    assert "enabled until" in cellctl("status").out
    assert cellctl("run", "move").code == 0


def test_procedures_and_runs_are_listed(cellctl):
    assert "There are no runs yet" in cellctl("runs").out
    said = cellctl("procedures")
    assert "n pause_s verdict" in said.out
    assert cellctl("procedures", "--json").json["procedures"][0]["name"] == "count"
    started(cellctl, "count", "--param", "n=0")
    assert "count" in cellctl("runs", "--limit", "1").out


def test_a_report_is_written_and_shown(cellctl):
    run_id = started(cellctl, "count")
    assert cellctl("watch", run_id).code == 0
    assert f"not written yet: cellctl report {run_id}" in cellctl("show").out
    said = cellctl("report", "latest")
    assert said.code == 0
    path = Path(said.out.strip())
    assert run_id in path.read_text()
    assert said.out.strip() in " ".join(cellctl("show").out.split())
    assert cellctl("show", "--json").json["report"] == str(path)
    assert cellctl("report", run_id, "--json").json == {"run": run_id, "report": str(path)}


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["run", "nope"], 6, "there are: count, ask, fault, move"),
        (["run", "count", "--param", "m=1"], 2, "unknown parameter 'm'"),
        (["run", "count", "--param", "n"], 2, "expected name=value"),
        (["run", "count", "--param", "n=1", "--param", "n=2"], 2, "given twice"),
        (["run", "count", "--speed", "0"], 2, "speed"),
        (["run", "count", "--speed", "fast"], 2, "--speed"),
        (["run", "count", "--request-id", "short"], 2, "request_id"),
        (["run"], 2, "name a procedure"),
        (["run", "../x"], 2, "not a name"),
        (["show", "nope"], 6, "neither a run nor a calibration"),
        (["watch", "nope"], 6, "no run 'nope'"),
        (["promote", "nope"], 6, "nope"),
        (["runs", "--limit", "0"], 2, "--limit"),
        (["status", "--cell", "UPPER"], 2, "cell id"),
        (["nope"], 2, "No such command"),
        (["status", "--nope"], 2, "--nope"),
        (["show"], 6, "there are no runs yet"),
        (["report", "nope"], 6, "no run 'nope'"),
        (["report", "latest"], 6, "there are no runs yet"),
        (["report", "nowhere/at-all"], 6, "no such folder"),
    ],
)
def test_errors_are_text_with_an_exit_code_and_json_when_asked(cellctl, arguments, code, text):
    said = cellctl(*arguments)
    assert (said.code, said.out) == (code, "")
    assert text in said.err
    assert "Traceback" not in said.err
    as_json = cellctl(*arguments, "--json")
    assert as_json.code == code
    assert text in as_json.json["error"]["message"]


def test_another_cell_is_unreachable(cellctl, monkeypatch):
    monkeypatch.setattr("cellctl.bus.queries.PAUSE_S", 0.01)
    said = cellctl("status", "--cell", "other", "--json")
    assert said.code == 5
    assert said.json["error"]["details"]["cells"] == ["toy"]


def test_names_of_procedures_are_completed(cellctl, monkeypatch, endpoint):
    assert _complete("") == ["count", "ask", "fault", "move"]
    assert _complete("c") == ["count"]
    monkeypatch.setenv("CELLCTL_CONNECT", free_endpoint())
    start = time.monotonic()
    assert _complete("") == []
    assert time.monotonic() - start < 1.8


def test_nobody_listens(offline, endpoint):
    said = offline("status", "--connect", endpoint)
    assert said.code == 5
    assert endpoint in said.err
