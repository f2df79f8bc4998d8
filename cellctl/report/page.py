"""The report of a run: read what is there, lay it out, write it whole or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import structlog
from jinja2 import Environment, PackageLoader, StrictUndefined

from cellctl.errors import printable
from cellctl.report import (
    accuracy,
    arrows,
    coverage,
    photos,
    provenance,
    refinement,
    rejected,
    residuals,
    stage_table,
)
from cellctl.report.blocks import Note, Section
from cellctl.report.odd import text
from cellctl.report.recorded import Recorded, read_recorded
from cellctl.report.verdict import verdict_of
from cellctl.store.files import storage, utc_now, write_atomically
from cellctl.store.run_folder import report_path

SECTIONS: tuple[tuple[str, Callable[[Recorded], Section]], ...] = (
    ("stages", stage_table.section),
    ("table", arrows.section),
    ("accuracy", accuracy.section),
    ("coverage", coverage.section),
    ("residuals", residuals.section),
    ("refinement", refinement.section),
    ("rejected", rejected.section),
    ("pictures", photos.section),
    ("record", provenance.section),
)

log = structlog.get_logger(__name__)


def write_report(run_directory: Path) -> Path:
    """Write `report/index.html` into the folder of a run, however the run ended; returns its path.

    Only the folder is read. What is missing or odd is said in the report. Raises BadInput when
    the folder is not that of a run, StorageFault when it cannot be written. Who writes the same
    report at the same time waits, so that the last one written is the last one read.
    """
    path = report_path(run_directory)
    recorded = read_recorded(run_directory)
    with storage(path):
        path.parent.mkdir(exist_ok=True)
        with _alone(path.parent):
            recorded = read_recorded(run_directory)
            write_atomically(path, printable(render(recorded)).encode())
    return path


@contextlib.contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """While nobody else writes a report there; given back also when this process dies."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def render(recorded: Recorded) -> str:
    """The page as HTML."""
    return (
        _environment()
        .get_template("report.html")
        .render(
            run_id=text(recorded.header.run_id),
            cell=text(recorded.header.cell),
            procedure=text(recorded.header.procedure),
            verdict=verdict_of(recorded),
            sections=[_made(name, make, recorded) for name, make in SECTIONS],
            incomplete=len(recorded.problems),
            written=utc_now(),
        )
    )


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("cellctl.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )


def _made(name: str, make: Callable[[Recorded], Section], recorded: Recorded) -> Section:
    """A section; one that cannot be made must not take the verdict with it."""
    try:
        return make(recorded)
    except Exception as error:
        log.exception("a section of a report failed", run=recorded.header.run_id, section=name)
        told = f"This part could not be made: {text(repr(error))}. Please report it."
        return Section(name, name.capitalize(), "", [Note(told, "missing")])
