"""The policy: only what passed and was measured to be no worse."""

from __future__ import annotations

import pytest

from cellctl.promotion import by_hand, not_worse


def file(error=None, interval=None, verdict="pass"):
    quality = {"held_out_mm": error, "held_out_ci_mm": interval}
    known = {name: value for name, value in quality.items() if value is not None}
    return {"verdict": verdict, "calibration": {"quality": known}}


ACTIVE = file(0.30, [0.12, 0.38])


@pytest.mark.parametrize(
    ("new", "active", "promoted"),
    [
        (file(0.29), ACTIVE, True),
        (file(0.37), ACTIVE, True),  # within what the active one may be
        (file(0.39), ACTIVE, False),
        (file(0.10, verdict="fail"), ACTIVE, False),
        (file(), ACTIVE, False),  # never measured
        (file(), None, False),
        (file(0.5), None, True),
        (file(0.5), file(), True),  # the active one was never measured
        ({"verdict": "pass"}, ACTIVE, False),
    ],
)
def test_only_what_passed_and_is_no_worse(new, active, promoted):
    assert not_worse(new, active) is promoted
    assert by_hand(new, active) is False
