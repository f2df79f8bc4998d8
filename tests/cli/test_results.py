"""Results as a person reads them: short, aligned, nothing silently cut."""

from __future__ import annotations

from cellctl.cli.results import print_data

MATRIX = [[1.0, 0.0], [0.0, 1.0]]


def shown(data, capsys):
    print_data(data)
    return capsys.readouterr().out.splitlines()


def test_figures_stand_in_one_column(capsys):
    lines = shown({"kind": "full", "hand-eye": {"summary": {"robot_sigma_mm": 0.25}}}, capsys)
    assert [line.split() for line in lines] == [
        ["kind", "full"],
        ["hand-eye.summary.robot_sigma_mm", "0.25"],
    ]
    assert lines[0].index("full") == lines[1].index("0.25")


def test_what_is_deep_or_long_is_counted(capsys):
    views = {f"view-{i:03}": {"rms": 0.1} for i in range(30)}
    lines = shown(
        {"intrinsic": {"per_view_px": views, "K": MATRIX, "used": list("abcdefg")}}, capsys
    )
    assert [line.split(maxsplit=1)[1] for line in lines] == ["(30 items)", "(2 items)", "(7 items)"]


def test_rows_become_a_table_without_their_objects(capsys):
    rows = [{"name": name, "px": 0.5, "calibration": {"K": MATRIX}} for name in ("one", "two")]
    text = "\n".join(shown({"stages": rows}, capsys))
    assert "stages" in text
    assert "one" in text
    assert "calibration" not in text
