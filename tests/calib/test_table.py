"""The table from touches: recovered truth, honest uncertainty, bow only when it shows."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cellctl.calib.table import judge, solve_table
from cellctl.calib.table_surface import Area, TableSurface
from cellctl.errors import BadInput, CellctlError, SolveError
from cellctl.geometry import Array

LOW, HIGH = np.array([-0.33, -0.63]), np.array([0.33, -0.25])
AREA = Area(LOW, HIGH)


def truth(xy: Array, bow_m: float, twist_m: float = 0.0) -> Array:
    """z of a table tilted by 1.5 mrad each way whose bow is `bow_m` from middle to edge."""
    u, v = ((xy - (LOW + HIGH) / 2) / ((HIGH - LOW) / 2)).T
    return 0.02 + 0.0015 * (xy[:, 0] - xy[:, 1]) - bow_m / 2 * (u * u + v * v) + twist_m * u * v


def touches(
    count: int, *, bow_m: float = 0.0, twist_m: float = 0.0, noise_m: float = 6e-5, seed: int = 0
) -> Array:
    """(n, 3) on a jittered grid over the area, its edges included."""
    rng = np.random.default_rng(seed)
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    share = np.stack(
        np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)), axis=-1
    ).reshape(-1, 2)[:count]
    share = np.clip(share + rng.uniform(-0.05, 0.05, share.shape), 0.0, 1.0)
    xy = LOW + share * (HIGH - LOW)
    z = truth(xy, bow_m, twist_m) + rng.normal(0, noise_m, count)
    return np.column_stack([xy, z])


@pytest.mark.parametrize("count", [3, 6, 12])
def test_a_plane_is_recovered(count):
    surface = solve_table(touches(count, noise_m=0.0), area=AREA)
    xy = AREA.grid()
    assert np.allclose(surface.height(xy), truth(xy, 0.0), atol=1e-9)
    assert surface.kind == "plane"
    assert surface.bow_m == 0.0
    ends = surface.plane.intersect(np.array([0.1, -0.4, 1.0]), np.array([[0.0, 0.0, -1.0]]))
    assert ends[0, 2] == pytest.approx(truth(np.array([[0.1, -0.4]]), 0.0)[0], abs=1e-9)
    slope = np.arccos(surface.plane.normal[2])
    assert slope == pytest.approx(0.0015 * np.sqrt(2), rel=1e-3)


def test_a_bow_is_recovered():
    surface = solve_table(touches(16, bow_m=1e-3), area=AREA)
    xy = AREA.grid()
    assert surface.kind == "bow"
    assert np.abs(surface.height(xy) - truth(xy, 1e-3)).max() < 1.5e-4
    assert surface.uncertainty_m < 3e-4
    assert surface.bow_m == pytest.approx(1e-3 * 2 / 3, rel=0.2)
    assert surface.held_out_mm["bow"] < 0.5 * surface.held_out_mm["plane"]


def test_a_twist_is_recovered():
    surface = solve_table(touches(20, bow_m=1e-3, twist_m=6e-4), area=AREA)
    assert surface.kind == "bow and twist"
    assert np.abs(surface.height(AREA.grid()) - truth(AREA.grid(), 1e-3, 6e-4)).max() < 2.5e-4


def test_a_flat_table_is_not_bowed():
    kinds = [solve_table(touches(16, seed=seed)).kind for seed in range(60)]
    assert kinds.count("plane") >= 54


def test_few_touches_do_not_tell_a_bow():
    surface = solve_table(touches(8, bow_m=1e-3), area=AREA)
    assert surface.kind == "plane"
    off = surface.height(AREA.grid()) - truth(AREA.grid(), 1e-3)
    assert np.abs(off).max() < surface.uncertainty_m


def test_two_rows_do_not_tell_a_bow():
    made = touches(12, noise_m=0.0)
    made[:, 1] = np.where(np.arange(12) < 6, LOW[1], HIGH[1])
    assert solve_table(made).kind == "plane"


@pytest.mark.parametrize(("count", "bow_m"), [(6, 0.0), (12, 0.0), (16, 1e-3)])
def test_uncertainty_is_the_scatter_of_repeated_solves(count, bow_m):
    surfaces = [solve_table(touches(count, bow_m=bow_m, seed=s), area=AREA) for s in range(250)]
    surfaces = [s for s in surfaces if s.kind == ("bow" if bow_m else "plane")]
    assert len(surfaces) > 200
    places = AREA.grid()[::20]
    off = np.array([s.height(places) - truth(places, bow_m) for s in surfaces])
    intervals = np.array([s.uncertainty_at(places) for s in surfaces])
    anywhere = np.array([s.uncertainty_m for s in surfaces])
    assert np.mean(np.abs(off) <= intervals) == pytest.approx(0.95, abs=0.03)
    assert 0.93 < np.mean(np.abs(off).max(axis=1) <= anywhere) < 0.995


def test_the_planes_covariance_is_the_scatter():
    xy = touches(12)[:, :2]
    rng = np.random.default_rng(1)
    found, predicted = [], []
    for _ in range(300):
        z = truth(xy, 0.0) + rng.normal(0, 6e-5, len(xy))
        surface = solve_table(np.column_stack([xy, z]))
        if surface.kind != "plane" or surface.rejected:
            continue
        normal = surface.plane.normal
        found.append([surface.plane.point[2], -normal[0] / normal[2], -normal[1] / normal[2]])
        predicted.append(surface.plane_covariance)
    sigma = np.sqrt(np.mean(predicted, axis=0).diagonal())
    assert np.std(found, axis=0) / sigma == pytest.approx([1.0] * 3, abs=0.15)


@pytest.mark.parametrize(("count", "bow_m"), [(7, 0.0), (9, 0.0), (12, 1e-3), (25, 1e-3)])
@pytest.mark.parametrize("which", [0, 4])
def test_a_touch_on_a_cable_is_left_out(count, bow_m, which):
    made = touches(count, bow_m=bow_m)
    made[which, 2] += 0.006
    surface = solve_table(made, ids=[f"t{i}" for i in range(count)])
    assert [r.id for r in surface.rejected] == [f"t{which}"]
    assert "above the surface" in surface.rejected[0].reason
    assert len(surface.used) == count - 1
    off = surface.height(made[:, :2]) - truth(made[:, :2], bow_m)
    assert np.abs(off).max() < 1e-3 + bow_m


def test_a_cable_among_few_touches_fails_the_verdict():
    made = touches(6)
    made[2, 2] += 0.004
    surface = solve_table(made, area=AREA)
    assert surface.rejected or judge(surface)[0] == "fail"


def test_verdict():
    assert judge(solve_table(touches(9), area=AREA)) == ("pass", ())
    verdict, reasons = judge(solve_table(touches(4), area=AREA))
    assert verdict == "fail"
    assert any("only 4 touches" in reason for reason in reasons)
    middle = touches(9, noise_m=2e-4)
    middle[:, :2] = 0.1 * (middle[:, :2] - middle[:, :2].mean(axis=0)) + (0.0, -0.44)
    verdict, reasons = judge(solve_table(middle, area=AREA))
    assert verdict == "fail"
    assert any("near the area's edges" in reason for reason in reasons)


@pytest.mark.parametrize("count", [3, 6, 16])
def test_written_and_read_again(count):
    surface = solve_table(touches(count, bow_m=1e-3), area=AREA)
    value = json.loads(json.dumps(surface.to_dict(), allow_nan=False))
    again = TableSurface.from_dict(value)
    assert again.to_dict() == surface.to_dict()
    assert np.array_equal(again.height(AREA.grid()), surface.height(AREA.grid()))


@pytest.mark.parametrize(
    ("made", "error", "words"),
    [
        (touches(2), SolveError, "2 touches"),
        (np.zeros((6, 3)), SolveError, "all touches lie within 0 mm"),
        (np.outer(np.arange(6), (0.1, 0.05, 0.0)), SolveError, "on a line"),
        (touches(6)[:, :2], BadInput, "n x 3"),
        (np.full((6, 3), np.nan), BadInput, "not finite"),
        ("points", BadInput, "no numbers"),
        ([[1.0, 2.0], [3.0]], BadInput, "no numbers"),
        (None, BadInput, "touches"),
    ],
)
def test_bad_input_is_named(made, error, words):
    with pytest.raises(error, match=words):
        solve_table(made)


def test_bad_areas_and_ids():
    with pytest.raises(BadInput, match="low must not exceed"):
        Area(HIGH, LOW)
    with pytest.raises(BadInput, match="different ids"):
        solve_table(touches(6), ids=["a"])


@settings(max_examples=80)
@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(0, 14), st.just(3)),
        elements=st.floats(-2, 2) | st.sampled_from([0.0, 1e-9, 0.1]),
    )
)
def test_whatever_touches_come(points):
    try:
        surface = solve_table(points)
    except CellctlError:
        return
    assert np.isfinite(surface.height(points[:, :2])).all()
    verdict, reasons = judge(surface)
    assert (verdict == "pass") == (not reasons)
    assert TableSurface.from_dict(surface.to_dict()).to_dict() == surface.to_dict()


VALUE = solve_table(touches(12, bow_m=1e-3)).to_dict()
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=3) | st.integers(-3, 9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@settings(max_examples=50)
@given(key=st.sampled_from(sorted(VALUE)), value=JSON)
def test_whatever_is_read(key, value):
    try:
        TableSurface.from_dict(VALUE | {key: value})
    except BadInput:
        return
    assert key in {"plane", "plane_covariance", "bow_m", "uncertainty_m"} or value is not None
