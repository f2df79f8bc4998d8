"""States, events and runs in words, for a person who has other things to do."""

from __future__ import annotations

import shlex
import time
from datetime import datetime
from typing import Any

from cellctl.bus.follow import Link, Update
from cellctl.messages import Event, Progress, Question, RunInfo, State


def headline(run: RunInfo) -> str:
    """The outcome of a run in one line, the verdict first."""
    name = f"{run.procedure} (run {run.run_id})"
    if run.status == "done":
        return f"{(run.verdict or 'done').upper()}: {name} has finished{_took(run)}."
    text = {
        "running": f"RUNNING: {name} goes on.",
        "waiting": f"WAITING: {name} waits for an operator.",
        "failed": f"FAILED: {name} has failed{_took(run)}.",
        "cancelled": f"CANCELLED: {name} was cancelled{_took(run)}.",
        "abandoned": f"ABANDONED: {name} was given up.",
        "interrupted": f"INTERRUPTED: {name} was interrupted; what it recorded is kept.",
    }[run.status]
    return f"{text} {run.error}" if run.error else text


def report(run: RunInfo) -> str | None:
    """Where the report of a run is, or how to get it; None while the run goes on."""
    if run.status in ("running", "waiting"):
        return None
    return run.report or f"not written yet: cellctl report {run.run_id}"


def advice(run: RunInfo) -> list[str]:
    """What can be done next."""
    if run.status == "interrupted":
        return [
            f"go on:    cellctl run --resume {run.run_id}",
            f"give up:  cellctl cancel {run.run_id}",
        ]
    if run.status == "done" and run.verdict == "pass" and run.calibration_id:
        return [f"use it:   cellctl promote {run.calibration_id}"]
    if run.question:
        return how_to_answer(run.question)
    return []


def how_to_answer(question: Question) -> list[str]:
    return [f"answer:   {answer_command(choice, question.id)}" for choice in question.choices]


def answer_command(choice: str, question: int | None) -> str:
    """The number is in it so that a command that is typed late answers nothing else."""
    number = "" if question is None else f" --question {question}"
    return f"cellctl ack --answer {shlex.quote(choice)}{number}"


def detached(run_id: str) -> list[str]:
    return [
        f"Detached; run {run_id} goes on in the cell.",
        f"follow:   cellctl watch {run_id}",
        f"cancel:   cellctl cancel {run_id}",
    ]


def motion(state: State) -> str:
    """Whether the cell may move."""
    if not state.enabled:
        command = state.enable_command or "cellctl enable --for 8h"
        return f"not enabled; on the cell's machine: {command}"
    if state.enabled_until is None:
        return "enabled always, by its config"
    return f"enabled until {clock(state.enabled_until)}"


def progress(value: Progress) -> str:
    count = f" {value.done}/{value.total}" if value.total else ""
    text = f": {value.text}" if value.text else ""
    return f"{value.step}{count}{text}"


def line(update: Update) -> str | None:
    """An update as one line; None for progress, which is a bar."""
    if isinstance(update, Event):
        return event(update)
    if isinstance(update, Link):
        return link(update)
    if isinstance(update, State):
        return f"{clock(update.wall_time)} {update.cell} is {standing(update)}"
    return None


def event(value: Event, *, of_one_run: bool = False) -> str:
    """What happened; the run is left out when there is only one it can be."""
    run = "" if of_one_run or value.run_id is None else f" {value.run_id}"
    data = {k: v for k, v in value.data.items() if k not in ("scope", "step", "key")}
    where = "/".join(filter(None, map(value.data.get, ("scope", "step", "key"))))
    return f"{clock(value.wall_time)} {value.kind}{run}{where and ' ' + where}{_data(data)}"


def link(value: Link) -> str:
    text = "the daemon is back" if value.alive else "the daemon is gone; waiting for it"
    return f"{clock(time.time())} {text} (boot {value.boot})"


def standing(state: State) -> str:
    """What the cell does, in a few words."""
    if state.phase == "fault":
        return f"FAULT: {state.fault}"
    doing = f": {state.procedure} (run {state.active_run})" if state.active_run else ""
    return f"{state.phase}{doing}"


def clock(wall_time: float) -> str:
    """Local time; with the date unless it is today's."""
    moment = datetime.fromtimestamp(wall_time).astimezone()
    today = moment.date() == datetime.now().astimezone().date()
    return moment.strftime("%H:%M:%S" if today else "%Y-%m-%d %H:%M")


def _took(run: RunInfo) -> str:
    try:
        start = datetime.fromisoformat(run.started)
        seconds = (datetime.fromisoformat(run.ended or "") - start).total_seconds()
    except ValueError:
        return ""
    return f" after {duration(seconds)}"


def duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{seconds // 60:.0f} min {seconds % 60:.0f} s"


def _data(data: dict[str, Any]) -> str:
    shown = (f"{key}={value}" for key, value in data.items() if value not in (None, "", [], {}))
    return "".join(f" {text if len(text) <= 120 else text[:117] + '...'}" for text in shown)
