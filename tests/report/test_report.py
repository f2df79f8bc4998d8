"""Reports of whole and of broken runs: what they say, and that nothing breaks them."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

from cellctl.errors import BadInput, StorageFault
from cellctl.report import write_report
from cellctl.report.phrases import figure
from tests.report import samples
from tests.report.pages import read_page

ORDER = [
    "stages",
    "table",
    "accuracy",
    "coverage",
    "residuals",
    "refinement",
    "rejected",
    "pictures",
    "record",
]
EVIL = "<script>alert(1)</script>\"'><img src=x onerror=alert(2)>"


@pytest.fixture(scope="module")
def recorded_once(tmp_path_factory):
    return samples.write_run(tmp_path_factory.mktemp("runs") / samples.RUN_ID)


@pytest.fixture
def run(recorded_once, tmp_path):
    """A complete run, to be spoilt."""
    return Path(shutil.copytree(recorded_once, tmp_path / samples.RUN_ID))


@pytest.fixture(scope="module")
def page(recorded_once):
    return read_page(write_report(recorded_once))


# -- a complete run


def test_a_report_is_one_small_file_that_needs_no_other(page):
    assert page.faults == []
    assert len(page.html) < 3_000_000
    assert page.ids == ORDER
    assert "could not be made" not in page.text


def test_the_verdict_comes_first_in_words(page):
    assert page.text.index("PASS") < page.text.index("misses the point") < 600
    sentence = "by 0.212 mm RMS (95 % interval 0.172 to 0.271 mm), measured on 12 circles"
    assert sentence.replace("95 %", "95%") in page.text.replace("95 %", "95%")
    assert "4 min 08 s" in page.text
    assert samples.CALIBRATION in page.text


def test_the_table_has_ours_and_the_papers_and_says_what_only_a_simulation_knows(page):
    table = page.section("stages")
    for row, (training, held_out, true, paper_px, paper_mm) in samples.ROWS.items():
        line = table[table.index(row) :]
        for value in (training, held_out, true, paper_px, paper_mm):
            assert figure(value) in line
    assert "true: known only in simulation" in table


def test_what_error_to_expect_why_and_what_to_do(page):
    told = page.section("accuracy")
    assert "0.118 mm" in told  # predicted
    assert "0.212 mm" in told  # measured
    assert "Most of the error comes from: drawing." in told
    assert told.index("draw 60 circles more") < told.index("take 30 views")
    assert "After 36 circles" in told
    assert page.html.count('class="heat"') == 35


def test_each_stage_has_a_map_with_its_magnification(page):
    maps = page.section("table")
    for row in samples.ROWS:
        assert row in maps
    assert maps.count("arrows \N{MULTIPLICATION SIGN}") >= len(samples.ROWS)
    assert "200 mm on the table" in maps
    assert page.html.count('class="arrow held"') >= len(samples.ROWS) * 12


def test_residuals_rejections_pictures_and_devices_are_there(page):
    for words in (
        "blurred: edges are 3.4 px wide",
        "1.1 px off the table's plane",
        "hidden by glare in 3 of 4 pictures",
        "void: it was not finished",
        "Chosen: affine",
        "robot-0017",
        "nightly-0031",
        "cal-20260124T061500101Z-77ab01",
        "intrinsic/views",
    ):
        assert words in page.text
    assert page.pictures == 4


def test_without_a_truth_nothing_is_called_true(run):
    (run / "report" / "truth.json").unlink()
    text = read_page(write_report(run)).text
    assert "known only in simulation" not in text
    assert "0.212" in text


def test_writing_again_replaces_the_report(run):
    first = write_report(run).read_text()
    (run / "report" / "truth.json").unlink()
    assert write_report(run).read_text() != first
    assert [path.name for path in (run / "report").iterdir()] == ["index.html"]


# -- other ends


@pytest.mark.parametrize(
    ("status", "word"),
    [
        ("failed", "FAILED"),
        ("cancelled", "CANCELLED"),
        ("interrupted", "INTERRUPTED"),
        ("abandoned", "ABANDONED"),
        ("running", "RUNNING"),
    ],
)
@pytest.mark.parametrize("until", ["intrinsic", "hand-eye", "projector"])
def test_a_run_without_a_result_shows_what_it_recorded(tmp_path, status, word, until):
    run = samples.write_run(tmp_path / samples.RUN_ID, status=status, until=until)
    page = read_page(write_report(run))
    assert page.faults == []
    assert page.ids == ORDER
    assert word in page.text[:200]
    assert ("check its cable" in page.text) == (status != "running")
    assert ("24 views of the checkerboard" in page.text) == (until != "intrinsic")
    assert "could not be made" not in page.text


def test_a_failed_verdict_is_told_with_its_reasons(tmp_path):
    run = samples.write_run(tmp_path / samples.RUN_ID, verdict="fail")
    text = read_page(write_report(run)).text
    assert "FAIL" in text[:100]
    assert "held-out error 1.90 mm, over the limit" in text[:800]
    assert "stays in use" in text[:800]


@pytest.mark.parametrize("part", ["intrinsic", "hand-eye", "projector"])
def test_a_procedure_alone_has_its_figures(tmp_path, part):
    run = samples.write_alone(tmp_path / samples.RUN_ID, part)
    page = read_page(write_report(run))
    assert page.faults == []
    assert "RMS held out" in page.text
    assert "the picture cannot be shown" not in page.text
    assert re.search(r"RMS \d", page.section("residuals"))


# -- what is missing or odd


def test_text_from_anywhere_is_only_text(tmp_path):
    run = samples.write_run(
        tmp_path / samples.RUN_ID,
        status="failed",
        error=EVIL,
        cell=EVIL,
        client=EVIL,
        params={EVIL: EVIL},
        devices={EVIL: {EVIL: EVIL}},
        versions={EVIL: EVIL},
        active_calibration=EVIL,
    )
    page = read_page(write_report(run))
    assert page.faults == []
    assert page.text.count("<script>alert(1)</script>") >= 5


def test_names_in_a_result_are_only_text(run):
    path = run / "result.json"
    result = json.loads(path.read_text().replace("circle-", f"{'<b>'}circle-"))
    data = result["data"]
    data["table"][0]["row"] = EVIL
    data["arrows"] = {EVIL: data["arrows"]["refinement"]}
    data["refine"]["candidates"] = {EVIL: {"note": EVIL}}
    data["intrinsic"]["views"]["rejected"] = [{"id": EVIL, "reason": EVIL}]
    data["intrinsic"]["verdict"] = EVIL
    path.write_text(json.dumps(result))
    page = read_page(write_report(run))
    assert page.faults == []
    assert "<b>" not in page.html


@pytest.mark.parametrize("missing", ["run.json", "journal.jsonl", "result.json", "images"])
def test_a_missing_file_is_said_and_the_rest_is_shown(run, missing):
    path = run / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    page = read_page(write_report(run))
    assert page.faults == []
    assert "cannot be read" in page.text or "is missing" in page.text
    assert "could not be made" not in page.text
    if missing != "journal.jsonl":
        assert "PASS" in page.text[:100]


def test_a_damaged_journal_is_said_and_its_other_lines_are_used(run):
    path = run / "journal.jsonl"
    lines = path.read_bytes().split(b"\n")
    lines[5] = lines[5].replace(b"flaw", b"flew")
    path.write_bytes(b"\n".join(lines) + b'{"n": 112, "t')
    page = read_page(write_report(run))
    assert page.faults == []
    assert "line 6 is damaged" in page.text
    assert "cut short" in page.text
    assert "PASS" in page.text[:100]


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"not the folder of a run"):
        write_report(tmp_path)


def test_only_pictures_of_the_run_itself_are_shown(run, tmp_path):
    elsewhere = tmp_path / "secret.png"
    shutil.copy(run / "images" / "intrinsic.views.view-000.image.png", elsewhere)
    text = (run / "journal.jsonl").read_text()
    writer = samples.Writer(tmp_path / "other")
    picture = {"file": "../secret.png", "sha256": samples.sha256_of(elsewhere)}
    data = {"key": "view-000", "data": {}, "images": {"image": picture}}
    writer.event("sample", data, "intrinsic/views")
    writer.close()
    assert "secret" not in text
    page = read_page(write_report(tmp_path / "other"))
    assert page.pictures == 0


def test_a_damaged_picture_is_said(run):
    path = run / "images" / "hand-eye.views.view-000.image.png"
    path.write_bytes(path.read_bytes()[:-100])
    page = read_page(write_report(run))
    assert page.pictures == 3
    assert "hand-eye: marker board, view-000: the picture cannot be shown" in page.text


def test_a_large_noisy_picture_does_not_make_the_page_large(tmp_path):
    run = tmp_path / samples.RUN_ID
    writer = samples.Writer(run)
    noise = np.random.default_rng(0).integers(0, 255, (2160, 3840), dtype=np.uint8)
    writer.sample("intrinsic/views", "view-000", {}, noise)
    writer.close()
    page = read_page(write_report(run))
    assert page.pictures == 1
    assert len(page.html) < 600_000


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_a_storage_fault(run):
    run.chmod(stat.S_IRUSR | stat.S_IXUSR)
    shutil.rmtree(run / "report", ignore_errors=True)
    with pytest.raises(StorageFault, match="permission denied"):
        write_report(run)


def test_a_file_where_the_report_should_be_is_a_storage_fault(run):
    shutil.rmtree(run / "report")
    (run / "report").write_text("in the way")
    with pytest.raises(StorageFault, match="cannot write"):
        write_report(run)
