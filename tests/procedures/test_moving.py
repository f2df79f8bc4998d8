"""Where the arm has been in a run."""

from __future__ import annotations

import numpy as np

from cellctl.procedures.moving import ways
from cellctl.store.history import Sample


def sample(n, *corners):
    way = {"way": np.multiply.outer(corners, np.ones(6)).tolist()} if corners else {}
    return {f"sample-{n}": Sample(n, f"sample-{n}", way, {})}


def test_ways_come_in_the_order_in_which_the_arm_went():
    """Out of the light, to the circles, and out again, which is the first step's second sample."""
    steps = {"park": sample(3, 1.0) | sample(9, 4.0), "circles": sample(5, 2.0, 3.0) | sample(7)}
    assert ways(steps)[:, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert ways({}).shape == (0, 6)
