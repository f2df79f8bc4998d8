"""What a run's journal says: its standing, its samples, its records. Pure functions of entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cellctl.journal import Entry
from cellctl.messages import Question, RunStatus, Verdict
from cellctl.pictures import Picture

ENDED: frozenset[RunStatus] = frozenset({"done", "failed", "cancelled", "abandoned"})
LIVE: frozenset[RunStatus] = frozenset({"running", "waiting"})


@dataclass(frozen=True)
class Standing:
    """Where a run stands after its newest event. `counts` are samples by step."""

    status: RunStatus = "running"
    verdict: Verdict | None = None
    reasons: tuple[str, ...] = ()
    error: str | None = None
    fault: str | None = None
    ended: str | None = None
    calibration_id: str | None = None
    question: Question | None = None
    step: str = ""
    step_total: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        return sum(self.counts.values())


def _going(standing: Standing, _: Entry) -> Standing:
    return replace(standing, status="running", error=None, ended=None, question=None)


def _question(standing: Standing, entry: Entry) -> Standing:
    question = Question(id=entry.n, text=entry.data["text"], choices=entry.data["choices"])
    return replace(standing, status="waiting", question=question)


def _step(standing: Standing, entry: Entry) -> Standing:
    return replace(standing, step=_step_of(entry), step_total=entry.data["total"])


def _sample(standing: Standing, entry: Entry) -> Standing:
    step = _step_of(entry)
    return replace(standing, counts={**standing.counts, step: standing.counts.get(step, 0) + 1})


def _step_of(entry: Entry) -> str:
    return address(entry.data["scope"], entry.data["step"])


def _end(status: RunStatus) -> Callable[[Standing, Entry], Standing]:
    def end(standing: Standing, entry: Entry) -> Standing:
        data = entry.data
        return replace(
            standing,
            status=status,
            error=data.get("error"),
            fault=data.get("fault"),
            ended=entry.time,
            question=None,
            verdict=data.get("verdict"),
            reasons=tuple(data.get("reasons", ())),
            calibration_id=data.get("calibration_id"),
        )

    return end


def _acknowledged(standing: Standing, _: Entry) -> Standing:
    return replace(standing, fault=None)


AFTER: Mapping[str, Callable[[Standing, Entry], Standing]] = {
    "started": _going,
    "resumed": _going,
    "step": _step,
    "sample": _sample,
    "question": _question,
    "answer": _going,
    "withdrawn": _going,
    "done": _end("done"),
    "failed": _end("failed"),
    "cancelled": _end("cancelled"),
    "interrupted": _end("interrupted"),
    "abandoned": _end("abandoned"),
    "acknowledged": _acknowledged,
}
"""What each kind of event does to a run's standing; other kinds do nothing."""


def advance(standing: Standing, entry: Entry) -> Standing:
    """The standing after one more event."""
    change = AFTER.get(entry.kind)
    return change(standing, entry) if change else standing


def standing_of(entries: Sequence[Entry]) -> Standing:
    """The standing after all of `entries`."""
    standing = Standing()
    for entry in entries:
        standing = advance(standing, entry)
    return standing


def address(*parts: str) -> str:
    """Scope, step and key as one name, empty ones left out: `full/hand-eye/collect/pose-03`."""
    return "/".join(part for part in parts if part)


@dataclass(frozen=True)
class Sample:
    """One recorded sample. `data` went through JSON, whether or not the run was resumed since."""

    key: str
    data: dict[str, Any]
    images: dict[str, Picture]


class History:
    """The entries of one run, to be asked. `entries` may still grow."""

    def __init__(self, directory: Path, entries: Sequence[Entry]) -> None:
        self._directory = directory
        self._entries = entries

    def samples(self, scope: str, step: str) -> dict[str, Sample]:
        """The samples of one step by their keys, in the order in which they were taken."""
        return {
            entry.data["key"]: self._sample(entry)
            for entry in self._of("sample", scope)
            if entry.data["step"] == step
        }

    def _sample(self, entry: Entry) -> Sample:
        images = {
            name: Picture(self._directory / named["file"], named["sha256"])
            for name, named in entry.data["images"].items()
        }
        return Sample(entry.data["key"], entry.data["data"], images)

    def records(self, scope: str, name: str) -> list[dict[str, Any]]:
        """What was recorded as `name`, oldest first."""
        found = self._of("record", scope)
        return [entry.data["data"] for entry in found if entry.data["name"] == name]

    def result(self) -> dict[str, Any] | None:
        """The result that the procedure came to, if it did."""
        found = [entry.data for entry in self._entries if entry.kind == "result"]
        return found[-1] if found else None

    def _of(self, kind: str, scope: str) -> list[Entry]:
        return [e for e in self._entries if e.kind == kind and e.data["scope"] == scope]
