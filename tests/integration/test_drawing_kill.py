"""The daemon killed while it draws, and what it does when it is back."""

from __future__ import annotations

import random
import time

import numpy as np

from tests.integration.drawing import CIRCLES, DRAW, assert_apart, drawn, ledger, rings
from tests.integration.known_cell import known_cell

WAIT_S = 120.0


def test_killed_while_it_draws_it_draws_nothing_twice(tmp_path):
    """Once at any instant, once with the pen on the paper."""
    with known_cell(tmp_path) as cell:
        with cell.client() as client:
            run_id = client.run("draw", DRAW).run_id
        await_circles(cell, run_id, 3)
        time.sleep(random.Random(0).uniform(0.0, 1.0))
        cell.kill()
        resumed(cell, run_id)
        await_circles(cell, run_id, 12)
        await_claim(cell)
        cell.kill()
        resumed(cell, run_id)
        info = cell.finish(run_id)
        assert (info.status, info.verdict, info.reasons) == ("done", "pass", [])
        assert_whole(cell, run_id)


def await_circles(cell, run_id, count):
    end = time.monotonic() + WAIT_S
    while len(cell.circles(run_id)) < count:
        assert time.monotonic() < end, cell.log()
        time.sleep(0.02)


def await_claim(cell):
    """Until the pen is, or is about to be, on the paper."""
    end = time.monotonic() + WAIT_S
    while all(spot["state"] == "drawn" for spot in ledger(cell)["spots"]):
        assert time.monotonic() < end, cell.log()


def resumed(cell, run_id):
    cell.start()
    with cell.client() as client:
        assert client.run_info(run_id).status == "interrupted"
        client.resume(run_id)


def assert_whole(cell, run_id):
    """The right number of circles; what was cut short is void, and nothing was drawn twice, says
    the journal as well as the world's paper."""
    circles = cell.circles(run_id)
    good = drawn(cell, run_id)
    cut = {key for key, circle in circles.items() if circle.get("flaw") == "cut short"}
    assert len(good) == CIRCLES
    assert 1 <= len(cut) <= 2
    spots = ledger(cell)["spots"]
    assert_apart(spots)
    mine = {s["owner"].split("/")[-1]: s["state"] for s in spots if s["owner"].startswith(run_id)}
    assert {key for key, state in mine.items() if state == "drawn"} == set(good)
    assert {key for key, state in mine.items() if state == "claimed"} == cut
    ink = np.array([ink["centre_m"][:2] for ink in rings(cell)])
    places = np.array([circle["xy"] for circle in circles.values()])
    nearest = np.linalg.norm(ink[:, None] - places, axis=2).argmin(axis=1)
    assert len(set(nearest)) == len(nearest)
    keys = list(circles)
    assert {keys[i] for i in nearest} >= set(good)
