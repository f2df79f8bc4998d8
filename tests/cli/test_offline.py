"""Commands that need no daemon."""

from __future__ import annotations

from pathlib import Path

import pytest

from cellctl.bus.session import free_endpoint
from cellctl.cli.boards import OPTIONS
from cellctl.local import DEFAULT_ENDPOINT
from cellctl.permission import FILE
from tests.report import samples

ROOT = Path(__file__).parents[2]


def test_a_board_is_made(offline, tmp_path):
    out = str(tmp_path / "board.pdf")
    said = offline("board", "make", "chessboard", "--size", "9x6", "--square", "30", "--out", out)
    assert said.code == 0
    assert "A3, landscape" in said.out
    assert 'board = { type = "chessboard", inner_corners = [9, 6], square_m = 0.03 }' in said.out
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")


def test_a_board_as_json(offline, tmp_path):
    out = str(tmp_path / "board.pdf")
    grid = ("--size", "3x4", "--marker", "50", "--pitch", "60", "--dictionary", "DICT_4X4_50")
    said = offline("board", "make", "aruco-grid", *grid, "--out", out, "--json")
    assert said.code == 0
    assert said.json["path"] == out
    assert said.json["page"] == "A4"
    assert said.json["board"] == {
        "type": "aruco-grid",
        "markers": [3, 4],
        "marker_m": 0.05,
        "pitch_m": 0.06,
        "dictionary": "DICT_4X4_50",
        "first_id": 0,
    }


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["chessboard", "--size", "9x6"], "chessboard also needs --square"),
        (["chessboard", "--size", "9", "--square", "30"], "expected COLUMNSxROWS"),
        (["chessboard", "--size", "9x6", "--square", "30", "--pitch", "3"], "has no --pitch"),
        (["circles", "--size", "9x6"], f"there are: {', '.join(OPTIONS)}"),
        (["dots", "--size", "9x6", "--spacing", "0"], "--spacing"),
        (["dots", "--size", "9x6", "--spacing", "30", "--page", "A9"], "expected A4 to A0"),
        (["dots", "--size", "9x6", "--spacing", "99", "--page", "A4"], "smallest that fits: A0"),
    ],
)
def test_boards_that_cannot_be_made(offline, tmp_path, arguments, text):
    out = tmp_path / "board.pdf"
    said = offline("board", "make", *arguments, "--out", str(out), "--json")
    assert said.code == 2
    assert text in said.json["error"]["message"]
    assert not out.exists()


def test_check_config(offline, tmp_path):
    said = offline("check-config", str(tmp_path / "none.toml"), "--json")
    assert said.code == 2
    assert "none.toml" in said.json["error"]["message"]
    broken = tmp_path / "broken.toml"
    broken.write_text("config_version = 1\n[cell]\nidd = 'x'\n")
    said = offline("check-config", str(broken))
    assert (said.code, said.out) == (2, "")
    assert "unknown key 'cell.idd'; did you mean 'id'?" in said.err


@pytest.mark.parametrize("duration", ["8", "h", "-1h", "1000h", ""])
def test_enable_refuses_what_is_no_duration(offline, tmp_path, monkeypatch, duration):
    monkeypatch.setenv("CELLCTL_DATA", str(tmp_path))
    assert offline("enable", f"--for={duration}").code == 2
    assert list(tmp_path.iterdir()) == []


def test_enable_writes_where_a_daemon_reads_it(offline, tmp_path, monkeypatch):
    """The default directory counts only when some daemon keeps its data there."""
    monkeypatch.delenv("CELLCTL_DATA", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    data = tmp_path / ".local" / "share" / "cellctl"
    said = offline("enable")
    assert said.code == 2
    assert f"no daemon keeps its data in {data}" in said.err
    assert not data.exists()
    data.mkdir(parents=True)
    (data / "lock").touch()
    assert offline("enable").code == 0
    assert (data / FILE).exists()


COMMANDS = (
    *("serve", "run", "status", "watch", "cancel", "ack", "runs", "show", "plan", "solve"),
    *("board", "promote", "enable", "check-config", "demo", "procedures"),
)


def test_help_names_every_command(offline):
    said = offline("--help")
    assert said.code == 0
    for command in COMMANDS:
        assert f"\n  {command} " in said.out


def test_check_config_of_the_cell_that_is_shipped(offline):
    said = offline("check-config", str(ROOT / "config" / "sim-cr.toml"), "--json")
    assert said.code == 0
    assert said.json["valid"]
    assert (said.json["cell"], said.json["arm"]) == ("sim-cr", "ur5")
    assert said.json["listen"] == DEFAULT_ENDPOINT


def test_a_report_of_a_folder_needs_no_daemon(offline, tmp_path):
    run = samples.write_run(tmp_path / "runs" / samples.RUN_ID, pictures=False, counts=(3, 3))
    said = offline("report", str(run))
    assert (said.code, said.out.strip()) == (0, str(run / "report" / "index.html"))
    assert offline("report", str(tmp_path)).code == 2


def test_without_a_daemon_a_run_is_found_in_the_data_directory(offline, tmp_path, monkeypatch):
    run = samples.write_run(tmp_path / "runs" / samples.RUN_ID, pictures=False, counts=(3, 3))
    monkeypatch.setenv("CELLCTL_CONNECT", free_endpoint())
    monkeypatch.setenv("CELLCTL_DATA", str(tmp_path))
    for name in ("latest", samples.RUN_ID):
        assert offline("report", name).out.strip() == str(run / "report" / "index.html")
    assert offline("report", "nope").code == 5
    monkeypatch.delenv("CELLCTL_DATA")
    assert "name the run's folder" in offline("report", "latest").err
