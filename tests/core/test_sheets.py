"""The ledger of used paper: what is on disk before the pen comes down is there after any crash."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.errors import BadInput
from cellctl.store.sheets import FILE, SheetLedger, Spot


async def at_once(function, /, *args):
    return function(*args)


def ledger(directory):
    return SheetLedger(directory, at_once)


def spot(owner: str) -> Spot:
    return Spot(0.1, -0.4, 0.01, owner)


async def test_a_claimed_spot_is_used_in_the_next_life(tmp_path):
    await ledger(tmp_path).claim("A", spot("run/circle-000"))
    reopened = ledger(tmp_path)
    assert reopened.claimed_by("run/circle-000")
    assert [s.state for s in reopened.spots("A")] == ["claimed"]
    await reopened.settle("A", "run/circle-000")
    await reopened.settle("A", "run/circle-000")
    assert [s.state for s in ledger(tmp_path).spots("A")] == ["drawn"]


async def test_a_spot_is_claimed_once(tmp_path):
    paper = ledger(tmp_path)
    await paper.claim("A", spot("run/circle-000"))
    with pytest.raises(ValueError, match="claimed once"):
        await paper.claim("B", spot("run/circle-000"))


async def test_fresh_paper_is_free_and_counted(tmp_path):
    paper = ledger(tmp_path)
    await paper.claim("A", spot("run/circle-000"))
    await paper.claim("B", spot("run/circle-001"))
    await paper.fresh("A")
    reopened = ledger(tmp_path)
    assert (reopened.spots("A"), reopened.laid("A")) == ([], 2)
    assert (len(reopened.spots("B")), reopened.laid("B")) == (1, 1)


async def test_a_damaged_ledger_says_what_is_wrong(tmp_path):
    await ledger(tmp_path).claim("A", spot("run/circle-000"))
    document = json.loads((tmp_path / FILE).read_text())
    document["sheets"]["A"]["spots"][0]["x"] = "left"
    (tmp_path / FILE).write_text(json.dumps(document))
    with pytest.raises(BadInput, match=r"sheets\.json: .*sheets\.A\.spots"):
        ledger(tmp_path)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(value=json_values)
def test_no_content_of_the_file_is_a_crash(tmp_path_factory, value):
    directory = tmp_path_factory.mktemp("ledger")
    content = {"schema": "cellctl-sheets/1", "sheets": value}
    (directory / FILE).write_text(json.dumps(content))
    try:
        found = ledger(directory)
    except BadInput:
        return
    assert found.spots("A") == [] or found.laid("A") >= 1
