"""A run's directory, to be read by whoever has it: the daemon, `solve`, a report."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from cellctl.errors import BadInput
from cellctl.explain import explain
from cellctl.messages import Progress, RunInfo
from cellctl.store.files import Schema, read_document
from cellctl.store.history import History, Standing, standing_of
from cellctl.store.journal import read

RUN = Schema("cellctl-run", 1)
RESULT = Schema("cellctl-result", 1)
JOURNAL = "journal.jsonl"


def report_path(directory: Path) -> Path:
    """Where the report of a run lies, once it is written."""
    return directory / "report" / "index.html"


class RunHeader(BaseModel):
    """run.json: all that is fixed when a run starts. `speed` is in percent."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    run_id: str
    procedure: str
    params: dict[str, Any] = {}
    speed: float = 100.0
    step: bool = False
    request_id: str
    client: str = "?"
    cell: str
    created: str
    boot: str = ""
    config_sha256: str = ""
    config: dict[str, Any] = {}
    versions: dict[str, str] = {}
    devices: dict[str, dict[str, str]] = {}
    active_calibration: str | None = None


@dataclass
class RunFolder:
    """A run as the store keeps it in mind."""

    directory: Path
    header: RunHeader
    standing: Standing = field(default_factory=Standing)

    def info(self) -> RunInfo:
        """What travels; without the result, which is on disk."""
        header, standing = self.header, self.standing
        report = report_path(self.directory)
        progress = Progress(
            run_id=header.run_id,
            step=standing.step,
            done=standing.counts.get(standing.step, 0),
            total=standing.step_total,
        )
        return RunInfo(
            run_id=header.run_id,
            procedure=header.procedure,
            status=standing.status,
            verdict=standing.verdict,
            reasons=list(standing.reasons),
            error=standing.error,
            samples=standing.samples,
            started=header.created,
            ended=standing.ended,
            params=header.params,
            progress=progress if standing.step else None,
            question=standing.question,
            calibration_id=standing.calibration_id,
            directory=str(self.directory),
            report=str(report) if report.exists() else None,
        )


def new_run_id() -> str:
    """Sortable by time, and a valid chunk of a key expression: `20260131T061500123Z-9f3a2c`."""
    now = datetime.now(UTC)
    return f"{now:%Y%m%dT%H%M%S}{now.microsecond // 1000:03d}Z-{secrets.token_hex(3)}"


def read_header(directory: Path) -> RunHeader:
    """run.json of a run directory. BadInput names the key that is wrong."""
    path = directory / "run.json"
    try:
        header = RunHeader.model_validate(read_document(path, RUN))
    except ValidationError as error:
        raise BadInput(f"{path}: {explain(error, RunHeader)}") from None
    return header


@dataclass(frozen=True)
class RecordedRun:
    """A run as read from its directory, by whoever has it; nothing is locked or changed."""

    header: RunHeader
    standing: Standing
    history: History


def read_run(directory: Path) -> RecordedRun:
    """Read a run directory. BadInput names the file (and line) that is missing or damaged."""
    header = read_header(directory)
    entries = read(directory / JOURNAL).intact()
    return RecordedRun(header, standing_of(entries), History(directory, entries))
