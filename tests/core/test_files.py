"""Atomic files, schemas, and errors of the disk in words."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cellctl.errors import BadInput, StorageFault
from cellctl.store.files import (
    Schema,
    read_document,
    sweep,
    to_json,
    write_atomically,
    write_document,
)

OLD = Schema("cellctl-thing", 2)
NEW = Schema("cellctl-thing", 3, upgrade=lambda content: {**content, "unit": "m"})


def test_a_document_carries_its_schema_first(tmp_path):
    write_document(tmp_path / "a.json", OLD, {"length": 1})
    assert (tmp_path / "a.json").read_text().startswith('{\n "schema": "cellctl-thing/2"')
    assert read_document(tmp_path / "a.json", OLD) == {"length": 1}


def test_the_version_before_is_read_and_others_are_refused_in_words(tmp_path):
    path = tmp_path / "a.json"
    write_document(path, OLD, {"length": 1})
    assert read_document(path, NEW) == {"length": 1, "unit": "m"}
    write_document(path, NEW, {"length": 1})
    with pytest.raises(BadInput, match=r"a\.json: written by a newer cellctl \(cellctl-thing/3"):
        read_document(path, OLD)
    write_document(path, Schema("cellctl-thing", 1), {})
    with pytest.raises(BadInput, match="too old"):
        read_document(path, NEW)
    with pytest.raises(BadInput, match="too old"):
        read_document(path, Schema("cellctl-thing", 2))
    with pytest.raises(BadInput, match="its schema is 'cellctl-thing/1', not 'cellctl-run/1'"):
        read_document(path, Schema("cellctl-run", 1))


@given(st.binary(max_size=40))
def test_whatever_a_file_holds_reading_it_is_an_answer_or_bad_input(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.json"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=r"any\.json"):
        read_document(path, OLD)


@pytest.mark.parametrize("content", [b"[1]", b"{}", b'{"schema": 7}', b"[" * 100_000, b'"\xff"'])
def test_awkward_files_are_bad_input(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(BadInput, match=r"a\.json"):
        read_document(tmp_path / "a.json", OLD)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"gone\.json: cannot be read: No such file"):
        read_document(tmp_path / "gone.json", OLD)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_survive_exactly(value):
    array = np.array([[value]])
    back = json.loads(to_json({"a": value, "b": array, "c": array[0, 0]}, "here"))
    assert (back["a"].hex(), back["b"][0][0].hex(), back["c"].hex()) == (value.hex(),) * 3


def test_what_is_not_finite_is_refused_by_name():
    with pytest.raises(BadInput, match="sample 3: cannot be written as JSON"):
        to_json({"a": np.array([1.0, np.inf])}, "sample 3")
    with pytest.raises(TypeError, match="set cannot be written"):
        to_json({"a": {1}}, "sample 3")


def test_a_write_that_fails_leaves_the_old_file_and_no_litter(tmp_path):
    path = tmp_path / "a.json"
    write_atomically(path, b"old")
    tmp_path.chmod(0o755)
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageFault, match="cannot write"):
        write_atomically(tmp_path / "folder", b"new")
    with pytest.raises(StorageFault, match="cannot write"):
        write_atomically(tmp_path / "nowhere" / "a.json", b"new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "folder"]
    assert path.read_bytes() == b"old"


def test_litter_of_a_crash_is_swept(tmp_path):
    (tmp_path / ".a.json.1234.tmp").write_bytes(b"half")
    (tmp_path / "a.json").write_bytes(b"whole")
    sweep(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
