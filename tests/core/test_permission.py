"""Permission to move: only a fresh, well-formed grant counts."""

from __future__ import annotations

import json
import math
import re
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.errors import BadInput, NotEnabled
from cellctl.permission import FILE, LONGEST_S, Permission, enable, parse_duration

NOW = 1_800_000_000.0


def test_without_a_grant_the_command_to_type_is_said(tmp_path):
    permission = Permission(tmp_path)
    assert permission.until() is None
    with pytest.raises(NotEnabled, match=r"motion is not enabled.*type: cellctl enable --for 8h"):
        permission.require()


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


@given(st.binary(max_size=200))
def test_no_bytes_enable_a_cell(tmp_path_factory, content):
    directory = tmp_path_factory.getbasetemp()
    (directory / FILE).write_bytes(content)
    assert Permission(directory).until(time.time()) is None


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
