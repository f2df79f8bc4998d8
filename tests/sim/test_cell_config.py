"""The simulated cell's config: the shipped file is the generated one, and its guard lets work."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from cellctl.config import load_config, parse_config
from cellctl.motion import guard_of
from cellctl.sim.bodies import bodies, plate_points
from cellctl.sim.cell_config import cell_document, to_toml
from cellctl.sim.presets import PRESETS
from cellctl.sim.truth import draw
from cellctl.sim.view import Plate
from tests.sim.worlds import CONFIG_FILE, WORK

CR = PRESETS["cr"]


def test_the_shipped_file_is_the_generated_one():
    assert CONFIG_FILE.read_text(encoding="utf-8") == to_toml(cell_document(CR, 0))
    assert load_config(CONFIG_FILE).cell.id == "sim-cr"


@pytest.mark.parametrize("seed", range(5))
def test_toml_says_what_the_document_says(seed):
    document = cell_document(CR, seed)
    assert tomllib.loads(to_toml(document)) == document
    config = parse_config(document, "generated")
    assert config.cell.motion_enabled
    assert config.projector.latency_s >= 0.035 + 5 * 0.008


@pytest.mark.parametrize("seed", range(8))
def test_the_guard_lets_the_arm_stand_at_home_and_over_the_table(seed):
    guard = guard_of(parse_config(cell_document(CR, seed), "generated"))
    for joints in (np.radians(CR.home_deg), WORK):
        violation = guard.first_violation(joints[None])
        assert violation is None, violation


@pytest.mark.parametrize("seed", range(3))
def test_hulls_contain_what_the_arm_truly_carries(seed):
    document = cell_document(CR, seed)
    hulls = [document["bracket"][name]["hull"] for name in ("checkerboard", "markers")]
    for body in bodies(draw(CR, seed)):
        if isinstance(body.shape, Plate):
            for point in plate_points(body.shape, 0.02):
                assert any(
                    (np.array(h["min_m"]) < point).all() and (point < np.array(h["max_m"])).all()
                    for h in hulls
                ), (body.name, point)


def test_other_seeds_are_other_cells():
    assert cell_document(CR, 1) != cell_document(CR, 2)
    assert cell_document(CR, 1) == cell_document(CR, 1)
