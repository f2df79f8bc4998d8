"""Permission to move: only a fresh, well-formed grant counts."""

from __future__ import annotations

import json
import math
import os
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.errors import BadInput, NotEnabled
from cellctl.permission import FILE, LONGEST_S, Permission, enable, parse_duration
from cellctl.store.files import read_document

NOW = 1_800_000_000.0


def test_without_a_grant_the_command_to_type_is_said(tmp_path):
    permission = Permission(tmp_path)
    assert permission.until() is None
    with pytest.raises(NotEnabled, match="motion is not enabled") as caught:
        permission.require()
    command = f"CELLCTL_DATA={tmp_path} cellctl enable --for 8h"
    assert caught.value.message.endswith(f"type: {command}")
    assert caught.value.details == {"command": command}


def test_a_grant_holds_until_it_ends(tmp_path):
    enable(tmp_path / "data", 3600, now=NOW)
    permission = Permission(tmp_path / "data")
    assert permission.until(NOW + 3599) == NOW + 3600
    permission.require(NOW + 3599)
    assert permission.until(NOW + 3600) is None
    with pytest.raises(NotEnabled, match="was enabled until 2027"):
        permission.require(NOW + 3600)


def test_enabling_again_replaces_the_grant(tmp_path):
    enable(tmp_path, 3600, now=NOW)
    grant = enable(tmp_path, 60, now=NOW)
    assert Permission(tmp_path).until(NOW) == grant.until == NOW + 60
    assert json.loads((tmp_path / FILE).read_text())["by"] == grant.by != ""


def test_a_simulated_cell_needs_none(tmp_path):
    permission = Permission(tmp_path, always=True)
    assert permission.until() == math.inf
    permission.require()


def test_a_clock_that_was_set_back_does_not_prolong_it(tmp_path):
    enable(tmp_path, 3600, now=NOW)
    Permission(tmp_path).require(NOW - 30)
    with pytest.raises(NotEnabled, match="the clock was changed"):
        Permission(tmp_path).require(NOW - 3600)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        '{"schema": "cellctl-permission/1"}',
        '{"schema": "cellctl-permission/2", "since": 0, "until": 1, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": "x", "until": 1, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": 0, "until": Infinity, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": true, "until": "1800000001", "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": NaN, "until": 9e99, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": 0, "until": 9e99, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": [], "until": {}, "by": "me"}',
        '{"schema": "cellctl-permission/1", "since": 0, "until": 1' + "0" * 400 + ', "by": ""}',
    ],
)
def test_a_malformed_grant_is_none(tmp_path, content):
    (tmp_path / FILE).write_text(content)
    assert Permission(tmp_path).until(NOW) is None
    with pytest.raises(NotEnabled, match="cellctl enable"):
        Permission(tmp_path).require(NOW)


VALID = {"schema": "cellctl-permission/1", "since": NOW - 10, "until": NOW + 3600, "by": "me"}
NASTY = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.floats(NOW - 2 * LONGEST_S, NOW + 2 * LONGEST_S),
    st.text(max_size=5),
    st.lists(st.floats(), max_size=2),
)


def permits(document) -> bool:
    """What the documentation says of a grant, in other words than the program's."""
    since, until = document.get("since"), document.get("until")
    if document.get("schema") != "cellctl-permission/1" or "by" not in document:
        return False
    if not all(type(moment) in (int, float) for moment in (since, until)):
        return False
    return since - 60 <= NOW < until <= since + LONGEST_S


@given(st.sampled_from(sorted(VALID)), st.one_of(st.just("missing"), NASTY))
def test_a_grant_counts_only_as_long_as_every_field_of_it_does(tmp_path_factory, field, value):
    directory = tmp_path_factory.getbasetemp()
    document = {**VALID, field: value}
    if value == "missing":
        del document[field]
    (directory / FILE).write_text(json.dumps(document))
    until = Permission(directory).until(NOW)
    assert until == (float(document["until"]) if permits(document) else None)


@given(st.integers(1, len(json.dumps(VALID)) - 1))
def test_a_grant_that_was_cut_short_is_none(tmp_path_factory, length):
    directory = tmp_path_factory.getbasetemp()
    (directory / FILE).write_text(json.dumps(VALID)[:length])
    assert Permission(directory).until(NOW) is None


def test_a_file_that_cannot_be_looked_at_is_no_permission_and_says_why(tmp_path):
    """As with a disk that reports errors, or a file system that has gone."""
    permission = Permission(tmp_path / ("d" * 300))
    assert permission.until() is None
    with pytest.raises(NotEnabled, match="cannot be read: File name too long"):
        permission.require()


def test_a_grant_is_read_once_and_again_when_it_was_replaced(tmp_path, monkeypatch):
    reads = []

    def counted(path, schema):
        reads.append(path)
        return read_document(path, schema)

    monkeypatch.setattr("cellctl.permission.read_document", counted)
    enable(tmp_path, 3600, now=NOW)
    permission = Permission(tmp_path)
    assert {permission.until(NOW) for _ in range(5)} == {NOW + 3600}
    assert len(reads) == 1
    enable(tmp_path, 1800, now=NOW)
    assert {permission.until(NOW) for _ in range(5)} == {NOW + 1800}
    assert len(reads) == 2
    (tmp_path / FILE).unlink()
    assert permission.until(NOW) is None


def test_a_user_without_a_name_can_enable(tmp_path, monkeypatch):
    def nameless():
        raise KeyError("getpwuid(): uid not found: 1234")

    monkeypatch.setattr("getpass.getuser", nameless)
    assert enable(tmp_path, 60).by == f"uid{os.getuid()}"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("8h", 28800), ("90m", 5400), ("1h30m", 5400), ("45s", 45), (" 2h ", 7200)],
)
def test_durations(text, seconds):
    assert parse_duration(text) == seconds


@given(st.text("0123456789hms -.x\n", max_size=12))
def test_other_durations_are_bad_input(text):
    if re.fullmatch(r"\s*(?=\d)(\d{1,6}h)?(\d{1,6}m)?(\d{1,6}s)?\s*", text):
        assert parse_duration(text) >= 0
    else:
        with pytest.raises(BadInput, match=re.escape(repr(text))):
            parse_duration(text)


@pytest.mark.parametrize("seconds", [0, -1, LONGEST_S + 1, math.nan, math.inf])
def test_it_is_not_enabled_for_ever(tmp_path, seconds):
    with pytest.raises(BadInput, match="up to 168h"):
        enable(tmp_path, seconds)
    assert not (tmp_path / FILE).exists()
