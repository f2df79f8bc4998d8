"""A run's folder as a report reads it: all that can be read, and a sentence for what cannot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cellctl.errors import BadInput
from cellctl.report.odd import at, mapping, text
from cellctl.report.phrases import moment
from cellctl.store.files import read_document
from cellctl.store.history import History, Sample, Standing, address, advance
from cellctl.store.journal import Entry, read
from cellctl.store.pictures import Picture
from cellctl.store.run_folder import JOURNAL, RESULT, RunHeader, read_header

TRUTH = "truth.json"
NOT_AN_EVENT = (KeyError, TypeError, ValueError, AttributeError, RecursionError)
"""What decoding an event raises that another version wrote, or a person."""

PARTS = (
    "intrinsic",
    "hand-eye",
    "projector",
    "measure-table",
    "tcp",
    "draw",
    "refine",
    "evaluate",
)


@dataclass
class Recorded:
    """A run, whatever is left of it. `result` is that of result.json, or the journal's; `truth`
    is what only a simulated cell can know. `problems` are sentences for a person."""

    directory: Path
    header: RunHeader
    standing: Standing = field(default_factory=Standing)
    entries: list[Entry] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    calibration: dict[str, Any] = field(default_factory=dict)
    truth: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    _steps: dict[str, dict[str, Sample]] = field(default_factory=dict)

    @property
    def data(self) -> dict[str, Any]:
        """The result's figures."""
        return mapping(self.result, "data")

    @property
    def config(self) -> dict[str, Any]:
        return self.header.config

    def part(self, name: str) -> dict[str, Any]:
        """What one part came to: of `full` under its name, of a procedure alone all there is."""
        kind = self.data.get("kind", self.header.procedure)
        return self.data if kind == name else mapping(self.data, name)

    def params(self, name: str) -> dict[str, Any]:
        """The parameters of one part."""
        if self.header.procedure == name:
            return self.header.params
        return mapping(self.header.params, name.replace("-", "_"))

    def samples(self, part: str, step: str) -> dict[str, Sample]:
        """The samples of a part's step, by key and in the order they were taken."""
        if self.header.procedure == part:
            return self._steps.get(step, {})
        return self._steps.get(address(part, step), {})

    def steps_of(self, part: str) -> dict[str, dict[str, Sample]]:
        """All samples of a part, by step."""
        if self.header.procedure == part:
            return self._steps
        prefix = f"{part}/"
        found = {name: s for name, s in self._steps.items() if name.startswith(prefix)}
        return {name.removeprefix(prefix): samples for name, samples in found.items()}

    def picture_of(self, sample: Sample) -> Picture | None:
        """The sample's picture. None unless it lies in this folder: a journal from somewhere else
        shall not bring other files of this machine into a report."""
        for picture in sample.images.values():
            try:
                inside = picture.path.resolve().is_relative_to(self.directory.resolve())
            except (OSError, ValueError, RuntimeError):
                inside = False
            if inside:
                return picture
        return None

    def seconds(self) -> float | None:
        """From the start to the newest event."""
        times = [moment(entry.time) for entry in self.entries]
        known = [time for time in (moment(self.header.created), *times) if time is not None]
        return (known[-1] - known[0]).total_seconds() if known else None


def read_recorded(directory: Path) -> Recorded:
    """Read what is there. BadInput when the folder holds neither run.json nor a journal."""
    if not (directory / "run.json").exists() and not (directory / JOURNAL).exists():
        raise BadInput(f"{directory}: not the folder of a run: no run.json and no {JOURNAL}")
    recorded = Recorded(directory, _unknown(directory))
    _read_header(recorded)
    _read_journal(recorded)
    _read_result(recorded)
    _read_truth(recorded)
    return recorded


def _unknown(directory: Path) -> RunHeader:
    return RunHeader(run_id=directory.name, procedure="?", request_id="", cell="?", created="")


def _read_header(recorded: Recorded) -> None:
    try:
        recorded.header = read_header(recorded.directory)
    except BadInput as error:
        recorded.problems.append(f"What was asked for is not known: {error.message}")


def _read_journal(recorded: Recorded) -> None:
    try:
        reading = read(recorded.directory / JOURNAL)
    except BadInput as error:
        recorded.problems.append(f"There is no journal: {error.message}")
        return
    recorded.problems += reading.damage
    if reading.torn:
        recorded.problems.append(
            f"{JOURNAL}: its last line was cut short; what it said was not recorded"
        )
    history = History(recorded.directory, [])
    for entry in reading.entries:
        _take_in(recorded, history, entry)
    recorded._steps = history.steps()  # noqa: SLF001 - it is filled here and read by its methods
    recorded.result = _object(history.result())


def _take_in(recorded: Recorded, history: History, entry: Entry) -> None:
    """One event, if it is one that this version knows."""
    try:
        if not isinstance(entry.data, dict):
            raise TypeError("its data are no object")
        if entry.kind == "sample" and not isinstance(entry.data["key"], str):
            raise TypeError("its key is no text")
        standing = advance(recorded.standing, entry)
        history.add(entry)
    except NOT_AN_EVENT as error:
        recorded.problems.append(
            f"{JOURNAL}: event {entry.n} ({entry.kind}) is not as this version writes it: "
            f"{text(repr(error))}"
        )
        return
    recorded.standing = standing
    recorded.entries.append(entry)


def _read_result(recorded: Recorded) -> None:
    recorded.calibration = mapping(recorded.result, "calibration")
    path = recorded.directory / "result.json"
    if not path.exists():
        if recorded.standing.status == "done":
            recorded.problems.append("result.json is missing; the journal's copy is shown")
        return
    try:
        recorded.result = {**recorded.result, **read_document(path, RESULT)}
    except BadInput as error:
        recorded.problems.append(f"The result is not as it was written: {error.message}")


def _read_truth(recorded: Recorded) -> None:
    path = recorded.directory / "report" / TRUTH
    if not path.exists():
        return
    try:
        recorded.truth = _object(json.loads(path.read_bytes()))
    except (OSError, ValueError, RecursionError) as error:
        recorded.problems.append(f"report/{TRUTH} cannot be read: {text(str(error))}")


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def good(samples: dict[str, Sample], used: Sequence[str] | None) -> dict[str, Sample]:
    """Those that the result rests on; without a result, those that were not found bad."""
    if used is not None:
        return {key: sample for key, sample in samples.items() if key in used}
    return {key: sample for key, sample in samples.items() if not at(sample.data, "flaw")}
