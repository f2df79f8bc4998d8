"""What a run's journal says: its standing, its samples, its records. Pure functions of entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cellctl.messages import Question, RunStatus, Verdict
from cellctl.store.journal import Entry
from cellctl.store.pictures import Picture

ENDED: frozenset[RunStatus] = frozenset({"done", "failed", "cancelled", "abandoned"})
LIVE: frozenset[RunStatus] = frozenset({"running", "waiting"})


@dataclass(frozen=True)
class Standing:
    """Where a run stands after its newest event. `counts` are samples by `<scope>/<step>`."""

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
    return replace(standing, step=entry.at, step_total=entry.data["total"])


def _sample(standing: Standing, entry: Entry) -> Standing:
    counts = {**standing.counts, entry.at: standing.counts.get(entry.at, 0) + 1}
    return replace(standing, counts=counts)


def _end(status: RunStatus) -> Callable[[Standing, Entry], Standing]:
    def end(standing: Standing, entry: Entry) -> Standing:
        data = entry.data
        return replace(
            standing,
            status=status,
            error=data.get("error"),
            fault=data.get("fault") or standing.fault,
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
    """One recorded sample, the entry `n` of the journal. `data` went through JSON, whether or not
    the run was resumed since."""

    n: int
    key: str
    data: dict[str, Any]
    images: dict[str, Picture]


class History:
    """The events of one run, to be asked. More may be added, by one thread."""

    def __init__(self, directory: Path, entries: Sequence[Entry]) -> None:
        self._directory = directory
        self._samples: dict[str, dict[str, Sample]] = {}
        self._records: dict[tuple[str, str], list[dict[str, Any]]] = {}
        self._result: dict[str, Any] | None = None
        for entry in entries:
            self.add(entry)

    def add(self, entry: Entry) -> None:
        """Take in one more event."""
        data = entry.data
        if entry.kind == "sample":
            self._samples.setdefault(entry.at, {})[data["key"]] = self._sample(entry)
        elif entry.kind == "record":
            self._records.setdefault((entry.at, data["name"]), []).append(data["data"])
        elif entry.kind == "result":
            self._result = data

    def samples(self, step: str) -> dict[str, Sample]:
        """The samples of a step, as `<scope>/<step>`, by key and in the order they were taken."""
        return dict(self._samples.get(step, {}))

    def steps(self) -> dict[str, dict[str, Sample]]:
        """All samples, by step and key."""
        return {step: dict(samples) for step, samples in self._samples.items()}

    def records(self, scope: str, name: str) -> list[dict[str, Any]]:
        """What was recorded as `name` in a scope, oldest first."""
        return list(self._records.get((scope, name), []))

    def result(self) -> dict[str, Any] | None:
        """The result that the procedure came to, if it did."""
        return self._result

    def _sample(self, entry: Entry) -> Sample:
        data = entry.data
        images = {
            name: Picture(self._directory / named["file"], named["sha256"])
            for name, named in data["images"].items()
        }
        return Sample(entry.n, data["key"], data["data"], images)
