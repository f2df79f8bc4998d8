"""The phases of an engine, and what leads from one to another: one literal table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from cellctl.messages import Phase

PhaseEvent = Literal["start", "ask", "answer", "withdraw", "stop", "end", "fault", "ack"]

TRANSITIONS: Mapping[tuple[Phase, PhaseEvent], Phase] = {
    ("idle", "start"): "running",
    ("running", "ask"): "waiting",
    ("waiting", "answer"): "running",
    ("waiting", "withdraw"): "running",
    ("running", "stop"): "stopping",
    ("waiting", "stop"): "stopping",
    ("stopping", "end"): "idle",
    ("stopping", "fault"): "fault",
    ("fault", "ack"): "idle",
}


class IllegalTransition(Exception):
    """The program is defective: an event came in a phase that does not know it."""


def transition(phase: Phase, event: PhaseEvent) -> Phase:
    """The next phase; IllegalTransition unless TRANSITIONS has it."""
    try:
        return TRANSITIONS[phase, event]
    except KeyError:
        raise IllegalTransition(f"{event!r} in phase {phase!r}") from None
