"""A cell's TOML: what a person gets wrong is named with file, key and remedy."""

from __future__ import annotations

import pytest

from cellctl.config import load_config, parse_config
from cellctl.errors import BadInput
from tests import cells


def changed(path, value):
    document = cells.document()
    *groups, key = path.split(".")
    section = document
    for group in groups:
        section = section[group]
    section[key] = value
    return document


def test_a_sound_document_is_accepted():
    assert cells.config().robot.arm == "ur5"


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (
            "robot.joint_sped_deg_s",
            10,
            "'robot.joint_sped_deg_s'; did you mean 'joint_speed_deg_s'",
        ),
        ("colour", "red", "unknown key 'colour'; known here: bracket"),
        ("bracket.pen.tip_mm", [0, 0, 180], "did you mean 'tip_m'"),
        ("robot.arm", "ur55", "robot.arm: unknown arm 'ur55'; known: irb4600-60/2.05, ur5"),
        ("workspace.box.min_m", [1, 0, 0], "workspace.box.*min_m must be below max_m"),
        ("camera.image_size_px", [1920], "camera.image_size_px"),
        ("table.touched_height_m", float("nan"), "table.touched_height_m"),
        ("config_version", 2, "config_version"),
        ("simulation", None, "motion_enabled: only a cell with"),
        ("cell.id", "No Spaces", "cell.id"),
        ("cell.data_dir", "data", "cell.data_dir: 'data' would be another folder"),
        ("bus", {"listen": "tcp/0.0.0.0:7450"}, "bus.listen: .*loopback"),
        ("workspace.clearance_m", 0.01, "workspace.clearance_m: .*0.03"),
        ("bracket.markers.board", {"type": "hexagons"}, "bracket.markers.board.*hexagons"),
    ],
)
def test_bad_documents_are_explained(path, value, words):
    with pytest.raises(BadInput, match=words) as caught:
        parse_config(changed(path, value), "cell.toml")
    assert caught.value.message.startswith("cell.toml: ")


def test_nesting_without_end_is_explained(tmp_path):
    path = tmp_path / "deep.toml"
    path.write_text("a = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(BadInput, match=r"deep\.toml: "):
        load_config(path)


def test_missing_key_is_named():
    document = cells.document()
    del document["table"]["area_m"]
    with pytest.raises(BadInput, match=r"missing key 'table.area_m'"):
        parse_config(document, "cell.toml")


def test_real_cell_cannot_use_the_simulated_drivers():
    document = changed("simulation", None)
    document["cell"]["motion_enabled"] = False
    with pytest.raises(BadInput, match="needs a \\[simulation\\] section"):
        parse_config(document, "cell.toml")


def test_missing_and_broken_files_are_named(tmp_path):
    with pytest.raises(BadInput, match=r"nowhere\.toml: cannot be read"):
        load_config(tmp_path / "nowhere.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("[cell\n")
    with pytest.raises(BadInput, match=r"broken.toml: not valid TOML.*line 1"):
        load_config(broken)


def test_data_directory_of_the_environment_wins(monkeypatch, tmp_path):
    monkeypatch.setenv("CELLCTL_DATA", str(tmp_path))
    assert cells.config().data_dir() == tmp_path
    monkeypatch.delenv("CELLCTL_DATA")
    assert cells.config().data_dir().name == "cellctl"
