"""Drawing on the known cell, and what its paper must look like: shared by the tests of it."""

from __future__ import annotations

import itertools
import json

import numpy as np

from cellctl.store.sheets import FILE

DRAW = {"spots": 12, "rounds": 2}
CIRCLES = 24
AWAY_M = 3e-3
"""A circle may lie so far from where it was commanded: errors of arm and pen."""


def ledger(cell):
    return json.loads((cell.folder / FILE).read_text())["sheets"]["A"]


def drawn(cell, run_id):
    return {k: c for k, c in cell.circles(run_id).items() if c["state"] == "drawn"}


def assert_apart(spots):
    """No two circles meet; spots {x, y, radius_m}."""
    for a, b in itertools.combinations(spots, 2):
        apart = np.hypot(a["x"] - b["x"], a["y"] - b["y"])
        assert apart > a["radius_m"] + b["radius_m"], (a, b)


def rings(cell):
    """The circles on the world's paper; a touch leaves a dot only."""
    return [ink for ink in cell.ink() if ink["centre_m"]]


def assert_one_circle_each(cell, circles):
    """Each circle that was journalled is on the paper once, and nothing else is; the indices (n,)
    of their ink."""
    ink = np.array([ink["centre_m"][:2] for ink in rings(cell)])
    places = np.array([c["measured"]["xy"] for c in circles])
    distance = np.linalg.norm(places[:, None] - ink, axis=2)
    order = distance.argmin(axis=1)
    assert len(ink) == len(places)
    assert sorted(order) == list(range(len(places)))
    assert distance.min(axis=1).max() < AWAY_M
    return order
