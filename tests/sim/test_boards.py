"""The boards are what the config says they are: the product's own detectors find them so."""

from __future__ import annotations

import numpy as np
import pytest

from cellctl.calib.targets import board_from_dict
from cellctl.sim.noise import NoiseBank
from cellctl.sim.optics import Optics
from cellctl.sim.presets import CR
from cellctl.sim.textures import description
from cellctl.sim.truth import draw
from tests.sim.scenes import board_pixels, frames_with_flange, random_flange, still

SEED, VIEWS = 8, 8


@pytest.mark.parametrize("name", ["checkerboard", "markers"])
def test_detectors_find_printed_points_where_the_truth_projects_them(name):
    truth = draw(CR, SEED)
    optics, rng = Optics(truth), np.random.default_rng(6)
    bank = NoiseBank(SEED, CR.camera.size_px[::-1], CR.camera.noise_sigma)
    board = board_from_dict(description(name, CR.boards), name)
    means = []
    for i in range(VIEWS):
        flange = random_flange(truth, name, rng, distance=(0.35, 0.7))
        picture = bank.expose(optics.expose(still(frames_with_flange(flange))), f"{i}")
        detection = board.detect(picture)
        if detection is None:
            continue
        expected = board_pixels(truth, name, flange, detection.points[:, :2])
        errors = detection.pixels - expected
        assert np.sqrt((errors**2).mean()) < 0.3
        means.append(errors.mean(axis=0))
    assert len(means) >= VIEWS - 2
    assert np.abs(np.mean(means, axis=0)).max() < 0.02
