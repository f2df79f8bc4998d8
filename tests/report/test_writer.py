"""Reports written beside a running daemon: they come, they are logged when they do not, and no
run waits for them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from cellctl.report import ReportWriter
from tests.core.toy import bench
from tests.report import samples
from tests.report.pages import read_page


async def settled(writer: ReportWriter) -> None:
    """Until nothing is left to write."""
    async with asyncio.timeout(40):
        await asyncio.shield(writer.written())


async def test_reports_come_one_after_the_other_and_a_bad_folder_stops_none(tmp_path):
    run = samples.write_run(tmp_path / samples.RUN_ID, pictures=False, counts=(3, 3))
    writer = ReportWriter()
    with capture_logs() as logs:
        writer.ask(tmp_path / "nothing")
        writer.ask(run)
        await settled(writer)
    await writer.close()
    assert read_page(run / "report" / "index.html").text.startswith("PASS")
    told = [log["event"] for log in logs]
    assert told.count("no report was written") == 1
    assert told.count("report") == 1


async def test_a_report_that_takes_too_long_is_given_up_and_logged(tmp_path):
    run = samples.write_run(tmp_path / samples.RUN_ID, pictures=False, counts=(3, 3))
    writer = ReportWriter(timeout_s=0.001)
    with capture_logs() as logs:
        writer.ask(run)
        await settled(writer)
    await writer.close()
    assert "did not end within" in next(x["error"] for x in logs if "error" in x)


async def test_closing_gives_up_what_is_not_written(tmp_path):
    writer = ReportWriter()
    writer.ask(tmp_path)
    await asyncio.sleep(0.05)
    async with asyncio.timeout(5):
        await writer.close()
        await writer.close()
    writer.ask(tmp_path)
    await writer.written()


@pytest.mark.parametrize(("procedure", "status"), [("survey", "done"), ("no-result", "failed")])
async def test_the_engine_tells_the_folder_of_each_run_that_has_ended(tmp_path, procedure, status):
    told: list[Path] = []
    async with bench(tmp_path, report=told.append) as toy:
        run_id = await toy.start(procedure)
        info = await toy.ended(run_id)
        await toy.until(lambda: told)
        assert info.status == status
        assert told == [tmp_path / "runs" / run_id]
