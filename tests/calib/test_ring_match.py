"""Which ring is which: also where the pen is off, and the tool turned otherwise at each."""

from __future__ import annotations

import numpy as np

from cellctl.calib.ring_match import match_rings

PLACES = 0.1 * np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
RADII = np.full(len(PLACES), 0.011)
WHOLE = np.full(len(PLACES), True)
HALF_TURNED = np.where(np.arange(len(PLACES)) % 2, -1.0, 1.0)[:, None]
OFF_M = np.array([0.006, 0.0])
SEARCH_M = 0.015


def test_rings_of_a_pen_that_is_off_are_found_though_the_tool_was_turned():
    found = PLACES + HALF_TURNED * OFF_M
    matched = match_rings(PLACES, RADII, found, RADII, WHOLE, SEARCH_M)
    assert matched.tolist() == list(range(len(PLACES)))


def test_what_is_left_over_but_not_whole_is_nobodys():
    found = PLACES + HALF_TURNED * OFF_M
    matched = match_rings(PLACES, RADII, found, RADII, HALF_TURNED[:, 0] > 0, SEARCH_M)
    assert (matched >= 0).tolist() == (HALF_TURNED[:, 0] > 0).tolist()


def test_of_two_left_over_rings_none_is_taken():
    found = np.vstack([PLACES + HALF_TURNED * OFF_M, PLACES[1] - 1.5 * OFF_M])
    radii, whole = np.append(RADII, 0.011), np.append(WHOLE, True)
    matched = match_rings(PLACES, RADII, found, radii, whole, SEARCH_M)
    assert matched[1] == -1
    assert (matched[[0, 2, 3]] == [0, 2, 3]).all()
