"""The journal: what was acknowledged is there, and what is damaged is said, by line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cellctl.errors import BadInput, StorageFault
from cellctl.store.files import Schema
from cellctl.store.journal import Journal, read
from tests.core.processes import python

DATA: list[dict[str, Any]] = [
    {"text": "über\nzwei Zeilen", "value": 0.1 + 0.2},
    {"list": [1, 2.5, None]},
    {},
]


def written(path: Path) -> bytes:
    """A journal of a header and three events."""
    path.unlink(missing_ok=True)
    journal = Journal.create(path, "run-1")
    for data in DATA:
        journal.append("event", data)
    journal.close()
    return path.read_bytes()


def test_what_was_appended_is_read_again(tmp_path):
    path = tmp_path / "journal.jsonl"
    content = written(path)
    entries = read(path).intact()
    assert [entry.n for entry in entries] == [0, 1, 2, 3]
    assert [entry.data for entry in entries[1:]] == DATA
    assert all(entry.time.endswith("Z") and len(entry.time) == 27 for entry in entries)
    assert len([json.loads(line) for line in content.splitlines()]) == 4


def test_append_returns_what_a_reader_will_see(tmp_path):
    journal = Journal.create(tmp_path / "journal.jsonl", "run-1")
    entry = journal.append("event", {"tuple": (1, 2), "nested": {3: "three"}}, at="a/b")
    journal.close()
    assert entry.data == {"tuple": [1, 2], "nested": {"3": "three"}}
    assert (entry.kind, entry.at) == ("event", "a/b")
    assert read(tmp_path / "journal.jsonl").intact()[1] == entry


def test_cut_at_every_byte_only_the_torn_line_is_missing(tmp_path):
    path = tmp_path / "journal.jsonl"
    content = written(path)
    for size in range(len(content)):
        path.write_bytes(content[:size])
        reading = read(path)
        whole = content[:size].count(b"\n")
        assert len(reading.entries) == whole
        assert reading.torn == content[:size].split(b"\n")[-1]
        assert bool(reading.damage) == (whole == 0)  # without its header it is no journal
        assert path.read_bytes() == content[:size]


def test_a_torn_line_is_moved_aside_and_its_number_used_again(tmp_path):
    path = tmp_path / "journal.jsonl"
    content = written(path)
    for again in range(2):
        path.write_bytes(content[:-5])
        journal, entries = Journal.open(path)
        entry = journal.append("event", {"again": again})
        journal.close()
        assert (len(entries), entry.n) == (3, 3)
        assert len(read(path).intact()) == 4
    torn = sorted(p.name for p in tmp_path.iterdir() if "torn" in p.name)
    assert torn == ["journal.jsonl.torn-3", "journal.jsonl.torn-3-2"]
    last_line = content.splitlines(keepends=True)[-1]
    assert (tmp_path / torn[0]).read_bytes() == last_line[:-5]


@settings(max_examples=150)
@given(st.data())
def test_a_flipped_byte_is_named_and_the_other_lines_are_rescued(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "flipped.jsonl"
    content = bytearray(written(path))
    intact = read(path).intact()
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    line = bytes(content[:place]).count(b"\n")
    reading = read(path)
    if reading.torn:  # the last newline itself
        assert (place, line) == (len(content) - 1, 3)
        assert reading.entries == intact[:3]
        return
    with pytest.raises(BadInput, match=f"flipped.jsonl line {line + 1}"):
        reading.intact()
    with pytest.raises(BadInput):
        Journal.open(path)
    assert path.read_bytes() == content
    lost = {line, line + 1} if content.count(b"\n") < 4 else {line}
    assert [e.n for e in reading.entries] == [n for n in range(4) if n not in lost]


@settings(max_examples=200)
@given(st.binary(max_size=300))
def test_any_bytes_are_read_without_a_crash(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "noise.jsonl"
    path.write_bytes(content)
    assert read(path).damage


def test_lines_that_are_missing_twice_or_of_another_journal_are_noticed(tmp_path):
    path = tmp_path / "journal.jsonl"
    lines = written(path).splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:2] + lines[3:]))
    with pytest.raises(BadInput, match="line 3: event 3 where 2 should be"):
        read(path).intact()
    path.write_bytes(b"".join([*lines, lines[2]]))
    with pytest.raises(BadInput, match="line 5: event 2 where 4 should be"):
        read(path).intact()
    path.write_bytes(b"".join(lines[1:]))
    with pytest.raises(BadInput, match="header is missing"):
        read(path).intact()


def test_a_newer_journal_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "journal.jsonl"
    monkeypatch.setattr("cellctl.store.journal.SCHEMA", Schema("cellctl-journal", 2))
    written(path)
    monkeypatch.undo()
    with pytest.raises(BadInput, match="written by a newer cellctl"):
        read(path)


def test_what_is_no_json_leaves_the_journal_as_it_is(tmp_path):
    journal = Journal.create(tmp_path / "journal.jsonl", "run-1")
    with pytest.raises(BadInput, match=r"sample a/b: cannot be written as JSON"):
        journal.append("sample", {"value": float("nan")}, at="a/b")
    for kind, at in (("Two words", ""), ("sample", 'a"b'), ("sample", "a\nb")):
        with pytest.raises(ValueError, match="plain names"):
            journal.append(kind, {}, at=at)
    assert journal.append("sample", {"value": 1.0}).n == 1
    journal.close()
    assert len(read(tmp_path / "journal.jsonl").intact()) == 2


FULL_DISK = """
import resource, sys
from pathlib import Path
from cellctl.errors import StorageFault
from cellctl.store.journal import Journal

path = Path(sys.argv[1])
journal = Journal.create(path, "run-1")
journal.append("event", {"text": "fits"})
resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 40, resource.RLIM_INFINITY))
for attempt in range(2):
    try:
        journal.append("event", {"text": "x" * 500})
    except StorageFault as fault:
        print(fault.message)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
try:
    journal.append("event", {"text": "after a failure the journal is not trusted"})
except StorageFault as fault:
    print(fault.message)
journal.close()
journal, entries = Journal.open(path)
print(journal.append("event", {"text": "opened again"}).n)
"""


def test_a_disk_that_is_full_takes_nothing_half(tmp_path):
    """The kernel stops the file's growth in the middle of a line, as a full disk does."""
    path = tmp_path / "journal.jsonl"
    with python("-c", FULL_DISK, str(path)) as process:
        *faults, number = process.communicate()[0].splitlines()
    assert len(faults) == 3
    assert all("journal.jsonl: the file would become larger" in fault for fault in faults)
    assert number == "2"
    assert [e.data.get("text") for e in read(path).intact()] == [None, "fits", "opened again"]
    assert not list(tmp_path.glob("*torn*"))


def test_a_device_that_is_full_says_so():
    journal = Journal(Path("/dev/full"), count=1)
    with pytest.raises(StorageFault, match="/dev/full: the disk is full: free some space"):
        journal.append("event", {})
    journal.close()
