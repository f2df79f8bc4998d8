"""What was recorded and not used, and why."""

from __future__ import annotations

from cellctl.report.blocks import Block, Note, Section, Table
from cellctl.report.odd import at, rows, text
from cellctl.report.phrases import plural
from cellctl.report.recorded import PARTS, Recorded

MOST = 200
NO_REASON = "no reason was given"
VOID = "void: it was not finished"


def section(recorded: Recorded) -> Section:
    """One table of views, markers and circles."""
    found = [row for part in PARTS for row in _of(recorded, part)]
    lead = (
        "A picture or a mark that is not used is kept, with the reason. What was looked at in "
        "search of a board is among them."
    )
    if not found:
        return Section("rejected", "What was rejected", "", [Note("Nothing was rejected.")])
    columns = [("step", False), ("what", False), ("which", False), ("why", False)]
    blocks: list[Block] = [Table(columns, found[:MOST])]
    if len(found) > MOST:
        blocks.append(
            Note(f"... and {plural(len(found) - MOST, 'more')[:-1]}; result.json has all.")
        )
    return Section("rejected", "What was rejected", lead, blocks)


def _of(recorded: Recorded, name: str) -> list[list[str]]:
    part = recorded.part(name)
    found = {
        (what, text(row.get("id"))): text(row.get("reason")) or NO_REASON
        for what, listed in (
            ("view", rows(part, "views", "rejected")),
            ("marker", rows(part, "markers", "rejected")),
            (
                "circle" if name in ("draw", "refine", "evaluate") else "point",
                rows(part, "rejected"),
            ),
        )
        for row in listed
    }
    for circle in rows(part, "circles"):
        state = text(circle.get("state"))
        if state not in ("", "good"):
            why = VOID if state == "void" else state
            found.setdefault(("circle", text(circle.get("key"))), why)
    void = part.get("void")
    for item in void if isinstance(void, list) else []:
        key = text(at(item, "key") or at(item, "id")) if isinstance(item, dict) else text(item)
        found.setdefault(("circle", key), text(at(item, "reason")) or VOID)
    found |= _flaws(recorded, name, found)
    return [[name, what, which, why] for (what, which), why in found.items()]


def _flaws(
    recorded: Recorded, name: str, known: dict[tuple[str, str], str]
) -> dict[tuple[str, str], str]:
    """Pictures that the journal calls bad; in a search, a board that is not seen is no news."""
    return {
        ("view" if step == "views" else step, key): text(flaw)
        for step, samples in recorded.steps_of(name).items()
        for key, sample in samples.items()
        if (flaw := at(sample.data, "flaw")) and ("view", key) not in known
    }
