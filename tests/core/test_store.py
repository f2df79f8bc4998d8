"""Runs and calibrations on disk: whole or not there, found again, never mixed up."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from cellctl.errors import BadInput, Busy, NotFound, StorageFault
from cellctl.store import Store
from cellctl.store.calibrations import CalibrationStore
from cellctl.store.history import standing_of
from cellctl.store.journal import read
from cellctl.store.run_folder import RunHeader, new_run_id, read_run
from tests.core.processes import python, said

IMAGE = np.random.default_rng(1).integers(0, 255, (60, 80), dtype=np.uint8)


def header(run_id="run-1", **changed):
    values = {
        "run_id": run_id,
        "procedure": "survey",
        "params": {"scale": 0.1 + 0.2},
        "request_id": f"request-{run_id}",
        "cell": "test",
        "created": "2027-01-15T08:00:00.000000Z",
    }
    return RunHeader(**{**values, **changed})


@pytest.fixture
async def store(tmp_path):
    store = await Store.open(tmp_path / "data")
    yield store
    await store.close()


async def again(store):
    """As after a restart of the daemon."""
    await store.close()
    return await Store.open(store.directory)


def test_run_ids_sort_by_time():
    ids = []
    for _ in range(5):
        ids.append(new_run_id())
        time.sleep(0.002)
    assert ids == sorted(ids)
    assert len(set(ids)) == 5


async def test_a_run_is_on_disk_when_it_is_created(store):
    record = await store.create(header())
    document = json.loads((record.directory / "run.json").read_text())
    assert document["schema"] == "cellctl-run/1"
    assert document["params"]["scale"] == 0.1 + 0.2
    assert [e.kind for e in read(record.directory / "journal.jsonl").intact()][1] == "started"
    assert not list(record.directory.parent.glob(".new-*"))
    await record.close()


async def test_a_sample_and_its_images_are_read_again_exactly(store):
    record = await store.create(header())
    data = {"joints": np.array([0.1, 1 / 3]), "n": np.int64(3)}
    await record.append_sample(
        "collect", "a", data, {"camera": IMAGE, "colour": np.stack([IMAGE] * 3, 2)}
    )
    await record.close()
    sample = read_run(record.directory).history.samples("collect")["a"]
    assert sample.data == {"joints": [0.1, 1 / 3], "n": 3}
    assert np.array_equal(sample.images["camera"].load(), IMAGE)
    assert sample.images["colour"].load().shape == (60, 80, 3)
    assert sample.images["camera"].path.name == "collect.a.camera.png"


async def test_a_changed_or_missing_image_is_named(store):
    record = await store.create(header())
    await record.append_sample("collect", "a", {}, {"camera": IMAGE})
    await record.close()
    picture = record.history.samples("collect")["a"].images["camera"]
    content = bytearray(picture.path.read_bytes())
    content[len(content) // 2] ^= 1
    picture.path.write_bytes(content)
    with pytest.raises(BadInput, match=r"collect\.a\.camera\.png: damaged"):
        picture.load()
    picture.path.unlink()
    with pytest.raises(BadInput, match=r"collect\.a\.camera\.png: cannot be read"):
        picture.load()


async def test_scopes_and_steps_are_kept_apart(store):
    record = await store.create(header())
    places = ["collect", "a/collect", "a/b/collect", "a/b"]
    for place in places:
        await record.append("step", at=place, total=3)
        await record.append_sample(place, "k", {"at": place}, {"i": IMAGE})
        await record.append("record", at=place, name="note", data={"at": place})
    history = record.history
    assert {step: samples["k"].data for step, samples in history.steps().items()} == {
        place: {"at": place} for place in places
    }
    assert history.records("a/b", "note") == [{"at": "a/b"}]
    assert history.samples("b") == {}
    assert len(list((record.directory / "images").iterdir())) == 4
    assert record.folder.standing.samples == 4
    assert record.folder.info().progress.step == "a/b"
    await record.close()


async def test_live_runs_are_interrupted_at_the_next_start(store):
    for run_id, last in (
        ("r1", "started"),
        ("r2", "question"),
        ("r3", "cancelled"),
        ("r4", "done"),
    ):
        record = await store.create(header(run_id))
        if last != "started":
            data = {"text": "?", "choices": ["ok"]} if last == "question" else {}
            await record.append(last, **data)
        await record.close()
    store = await again(store)
    statuses = [folder.standing.status for folder in store.folders()]
    assert statuses == ["interrupted", "interrupted", "cancelled", "done"]
    entry = read(store.directory / "runs" / "r2" / "journal.jsonl").intact()[-1]
    assert (entry.kind, entry.data["error"]) == (
        "interrupted",
        "the daemon ended in the middle of it",
    )
    assert store.folder("r2").info().question is None
    await store.close()


async def test_requests_are_found_again_after_a_restart(store):
    await (await store.create(header(request_id="request-77"))).close()
    store = await again(store)
    found = store.requested("request-77")
    assert found is not None
    assert found.header.run_id == "run-1"
    assert store.requested("request-78") is None
    await store.close()


async def test_an_unfinished_creation_leaves_nothing(store):
    unborn = store.directory / "runs" / ".new-run-9"
    unborn.mkdir()
    (unborn / "run.json").write_text("{")
    store = await again(store)
    assert store.folders() == []
    assert not unborn.exists()
    await store.close()


@pytest.mark.parametrize("step", ["Journal.append", "sync_directory"])
async def test_a_creation_that_the_disk_refuses_leaves_nothing(store, monkeypatch, step):
    """The line `started` is one that may be refused; so may be making the name durable."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"cellctl.store.store.{step}", full)
    with pytest.raises(StorageFault, match="disk is full"):
        await store.create(header())
    monkeypatch.undo()
    assert list((store.directory / "runs").iterdir()) == []
    assert store.requested("request-run-1") is None
    other = await store.create(header("run-2"))
    await other.close()
    reopened = await again(store)
    assert [folder.header.run_id for folder in reopened.folders()] == ["run-2"]
    await reopened.close()


async def test_a_damaged_run_is_listed_and_keeps_no_other_from_being_opened(store):
    for run_id in ("r1", "r2", "r3"):
        await (await store.create(header(run_id))).close()
    runs = store.directory / "runs"
    journal = runs / "r1" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes().replace(b"started", b"stArted"))
    (runs / "r2" / "run.json").write_text('{"schema": "cellctl-run/1", "run_id": 3}')
    before = journal.read_bytes()
    store = await again(store)
    infos = {folder.header.run_id: folder.info() for folder in store.folders()}
    assert "journal.jsonl line 2 is damaged: its checksum does not match" in infos["r1"].error
    assert "run.json: run_id" in infos["r2"].error
    assert [infos[name].status for name in ("r1", "r2", "r3")] == [
        "failed",
        "failed",
        "interrupted",
    ]
    assert journal.read_bytes() == before
    assert store.requested("request-r1") is not None
    await store.close()


async def test_a_copied_run_is_not_taken_for_the_original(store):
    await (await store.create(header("r1"))).close()
    runs = store.directory / "runs"
    shutil.copytree(runs / "r1", runs / "r1-copy")
    store = await again(store)
    copy = store.folder("r1-copy").info()
    assert (copy.run_id, copy.status) == ("r1-copy", "failed")
    assert "is that of run 'r1'" in str(copy.error)
    found = store.requested("request-r1")
    assert found is not None
    assert found.header.run_id == "r1"
    assert read_run(runs / "r1-copy").header.run_id == "r1"  # offline, a copy is as good
    await store.close()


async def test_a_run_of_a_newer_cellctl_is_refused_in_words(store):
    await (await store.create(header("r1"))).close()
    path = store.directory / "runs" / "r1" / "run.json"
    path.write_text(path.read_text().replace("cellctl-run/1", "cellctl-run/2"))
    with pytest.raises(BadInput, match="written by a newer cellctl"):
        read_run(path.parent)


async def test_writes_keep_their_order_also_when_nobody_waits_for_them(store):
    record = await store.create(header())
    tasks = [asyncio.create_task(record.append("event", number=n)) for n in range(20)]
    await asyncio.sleep(0)
    for task in tasks[::3]:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await record.close()
    entries = read(record.directory / "journal.jsonl").intact()
    numbers = [e.data["number"] for e in entries if e.kind == "event"]
    assert numbers == sorted(numbers)
    assert set(numbers) >= {n for n in range(20) if n % 3}
    assert standing_of(entries) == record.folder.standing


async def test_an_unknown_run_is_not_found(store):
    with pytest.raises(NotFound, match="no run 'x'; the newest are: none"):
        store.folder("x")


async def test_a_second_daemon_is_told_who_owns_the_directory(store):
    with pytest.raises(Busy, match=f"belongs to a running daemon .pid {os.getpid()}."):
        await Store.open(store.directory)
    other = await again(store)
    await other.close()


HOLD = """
import asyncio, sys
from pathlib import Path
from cellctl.store import Store

async def main():
    store = await Store.open(Path(sys.argv[1]))
    print("open", flush=True)
    await asyncio.sleep(60)

asyncio.run(main())
"""


async def test_a_killed_owner_leaves_no_lock(tmp_path):
    with python("-c", HOLD, str(tmp_path)) as owner:
        assert said(owner) == "open"
        with pytest.raises(Busy, match=f"pid {owner.pid}"):
            await Store.open(tmp_path)
        owner.kill()
        owner.wait()
        await (await Store.open(tmp_path)).close()


async def test_a_data_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageFault, match=r"cannot write .*file"):
        await Store.open(tmp_path / "file")


def calibration(verdict="pass", value=1.0):
    return {"verdict": verdict, "reasons": [], "calibration": {"f": value}}


@pytest.fixture
def calibrations(tmp_path):
    return CalibrationStore(tmp_path)


def test_calibrations_are_never_overwritten(calibrations, tmp_path):
    calibrations.add("c1", calibration(value=1 / 3))
    calibrations.add("c1", {**calibration(value=1 / 3), "stored": "later"})
    with pytest.raises(BadInput, match="never overwritten"):
        calibrations.add("c1", calibration(value=2.0))
    path = tmp_path / "calibrations" / "c1.json"
    assert json.loads(path.read_text())["calibration"] == {"f": 1 / 3}
    assert path.stat().st_mode & 0o222 == 0


def test_promotion_has_a_history(calibrations, tmp_path):
    for name in ("c1", "c2"):
        calibrations.add(name, calibration())
        calibrations.promote(name, "me", despite_failed_verdict=False)
    calibrations.promote("c2", "me", despite_failed_verdict=False)
    assert [(p["calibration_id"], p["verdict"]) for p in promotions(tmp_path)] == [
        ("c1", "pass"),
        ("c2", "pass"),
    ]
    assert CalibrationStore(tmp_path).info("active").calibration_id == "c2"
    assert not calibrations.info("c1").active


def promotions(directory):
    return json.loads((directory / "active.json").read_text())["history"]


def test_what_failed_is_promoted_only_when_that_is_said(calibrations, tmp_path):
    calibrations.add("good", calibration())
    calibrations.add("bad", calibration("fail"))
    calibrations.promote("good", "me", despite_failed_verdict=False)
    with pytest.raises(BadInput, match="bad failed its verdict"):
        calibrations.promote("bad", "me", despite_failed_verdict=False)
    assert calibrations.active == "good"
    calibrations.promote("bad", "me", despite_failed_verdict=True)
    assert calibrations.active == "bad"
    assert [p["verdict"] for p in promotions(tmp_path)] == ["pass", "fail"]


def test_what_is_not_there_is_not_found(calibrations):
    with pytest.raises(NotFound, match="no calibration has been promoted"):
        calibrations.info("active")
    calibrations.add("c1", calibration())
    with pytest.raises(NotFound, match="no calibration 'c2'; there are: c1"):
        calibrations.promote("c2", "me", despite_failed_verdict=True)
    for name in ("../run", "", "a/b", ".hidden"):
        with pytest.raises(BadInput, match="not the id"):
            calibrations.info(name)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not valid JSON"),
        ('{"schema": "cellctl-active/9", "history": []}', "newer cellctl"),
        ('{"schema": "cellctl-active/1", "history": {"c1": 1}}', "'history' must list"),
        ('{"schema": "cellctl-active/1", "history": [{"id": "c1"}]}', "'history' must list"),
        (
            '{"schema": "cellctl-active/1", "active": "c1", "history": []}',
            "'active' is 'c1', but the newest promotion in 'history' is of None",
        ),
        (
            '{"schema": "cellctl-active/1", "active": "c1", "history": [{"calibration_id": "c2"}]}',
            "'active' is 'c1', but the newest promotion in 'history' is of 'c2'",
        ),
        (
            '{"schema": "cellctl-active/1", "active": "g", "history": [{"calibration_id": "g"}]}',
            "names g, but .*g.json is not there: restore that file",
        ),
    ],
)
async def test_a_damaged_pointer_keeps_the_daemon_from_guessing(tmp_path, content, words):
    (tmp_path / "active.json").write_text(content)
    with pytest.raises(BadInput, match=rf"active\.json.*{words}"):
        await Store.open(tmp_path)
    (tmp_path / "active.json").unlink()
    await (await Store.open(Path(tmp_path))).close()
