"""Whatever a file of a run holds, there is a report, and none of its parts has failed."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from cellctl.report import write_report
from cellctl.report.page import render
from cellctl.report.recorded import read_recorded
from cellctl.store.files import to_json
from cellctl.store.journal import Entry, encode, read
from tests.report import samples
from tests.report.pages import Page, read_page

PHASES = (Phase.explicit, Phase.reuse, Phase.generate)
"""No shrinking: an example takes half a second, and the failing part names itself in the page."""
ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**400), 10**400),
    st.sampled_from([0, -1, 1e-300, 1e300, 1e11, -1e11]),
    st.floats(allow_nan=True),
    st.text(max_size=20),
    st.sampled_from([[], {}, [[]], [None], {"": None}, "\ud800", "<b>", "\x00", [1e308] * 3]),
    st.lists(st.floats(-1e6, 1e6), max_size=5),
)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A complete run with few views and no pictures, once for all examples."""
    run = samples.write_run(
        tmp_path_factory.mktemp("runs") / samples.RUN_ID, pictures=False, counts=(3, 3)
    )
    result = json.loads((run / "result.json").read_text())
    return run, result, read(run / "journal.jsonl").entries


def spoilt(draw: st.DataObject, document: Any, times: int = 3) -> Any:
    """A copy with odd values, or nothing, in some places."""
    document = copy.deepcopy(document)
    for _ in range(draw.draw(st.integers(1, times))):
        places = [(document, name) for name in _names(document)]
        while places:
            holder, name = places[draw.draw(st.integers(0, len(places) - 1))]
            inner = [(holder[name], key) for key in _names(holder[name])]
            if not inner or draw.draw(st.booleans()):
                if draw.draw(st.booleans()):
                    holder[name] = copy.deepcopy(draw.draw(ODD))
                else:
                    del holder[name]
                break
            places = inner
    return document


def _names(value: Any) -> list[Any]:
    """Of the members of an object or a list."""
    if isinstance(value, dict):
        return list(value)
    return list(range(len(value))) if isinstance(value, list) else []


def check(run: Path) -> None:
    page = Page(render(read_recorded(run)))
    assert page.faults == []
    assert "could not be made" not in page.text


@settings(max_examples=16, phases=PHASES)
@given(st.data())
def test_an_odd_result(small, data):
    run, result, _ = small
    path = run / "result.json"
    odd = json.dumps(spoilt(data, result))
    path.write_text(odd)
    try:
        check(run)
    finally:
        path.write_text(json.dumps(result))


@settings(max_examples=10, phases=PHASES)
@given(st.data())
def test_odd_events(small, data):
    run, _, entries = small
    path = run / "journal.jsonl"
    original = path.read_bytes()
    lines = [encode(entry) for entry in entries]
    for _ in range(data.draw(st.integers(1, 4))):
        n = data.draw(st.integers(1, len(entries) - 1))
        odd = json.dumps(spoilt(data, entries[n].data)).encode()
        entry = entries[n]
        lines[n] = encode(Entry(entry.n, entry.time, entry.kind, entry.at, odd))
    path.write_bytes(b"".join(lines))
    try:
        check(run)
    finally:
        path.write_bytes(original)


@settings(max_examples=10, phases=PHASES)
@given(st.data())
def test_an_odd_header_and_truth(small, data):
    run, _, _ = small
    header, truth = run / "run.json", run / "report" / "truth.json"
    originals = header.read_bytes(), truth.read_bytes()
    odd = spoilt(data, json.loads(originals[0])), spoilt(data, samples.truth())
    header.write_text(json.dumps(odd[0]))
    truth.write_text(json.dumps(odd[1]))
    try:
        check(run)
    finally:
        header.write_bytes(originals[0])
        truth.write_bytes(originals[1])


@settings(max_examples=10, phases=PHASES)
@given(content=st.binary(max_size=200), name=st.sampled_from(["run.json", "result.json"]))
def test_bytes_instead_of_json(small, content, name):
    run, _, _ = small
    path = run / name
    original = path.read_bytes()
    path.write_bytes(content)
    try:
        check(run)
    finally:
        path.write_bytes(original)


@pytest.mark.parametrize("body", ["[" * 100_000, '{"a":' * 100_000, "[1, 2]", '"text"', "NaN"])
def test_results_that_are_no_objects(tmp_path, body):
    run = tmp_path / samples.RUN_ID
    writer = samples.Writer(run)
    lines = [Entry(2, "2026-01-31T06:15:01.000000Z", "result", "", body.encode())]
    lines.append(Entry(3, "not a time", "done", "", to_json({"verdict": "pass"}, "test")))
    writer.lines += [encode(line) for line in lines]
    writer.close()
    (run / "result.json").write_text(body)
    page = read_page(write_report(run))
    assert page.faults == []
    assert "could not be made" not in page.text
