# SPDX-License-Identifier: MIT
"""Effects of ghost penalty and pressure-jump damping vanish with the cell size as fast as the discretisation error.

In yielding soil the damping uses the tangent.
"""

from functools import cache

import numpy as np
import pytest
from dolfinx import fem
from slump import alternating

import mpm_dolfinx as mpm
from mpm_dolfinx.flow.second_differences import second_differences
from mpm_dolfinx.forms.unknowns import Unknowns
from mpm_dolfinx.materials.evaluate import MOST
from mpm_dolfinx.mechanics.ghost_penalty import GHOST

SHEAR, LOAD, K = 1e6, 1e2, np.pi  # Pa, Pa, 1/m
CELLS = (8, 16, 32)


class Soil(mpm.LinearElastic):
    """Linear elasticity with another strength of the damping."""

    strength = 1.0

    def pressure_damping(self):
        return self.strength * super().pressure_damping()


def exact(x):
    """Return (displacement, pressure) of an undrained layer of 1 m on a smooth floor, with -LOAD cos(K x) on its top.

    Incompressible: u = curl psi, psi = (A sinh Ky + B y cosh Ky) sin Kx. Floor and walls at Kx = 0 and pi are free of
    shear. A and B follow from the tractions on the top.
    """

    def derivatives(y):
        """Return the two parts of psi in y and their first three derivatives."""
        s, c = np.sinh(K * y), np.cosh(K * y)
        a = np.stack([s, K * c, K**2 * s, K**3 * c])
        b = np.stack([y * c, c + K * y * s, 2 * K * s + K**2 * y * c, 3 * K**2 * c + K**3 * y * s])
        return a, b

    parts = derivatives(np.array(1.0))
    shear = [f[2] + K**2 * f[0] for f in parts]
    normal = [SHEAR / K * (f[3] - 3 * K**2 * f[1]) for f in parts]
    A, B = np.linalg.solve([shear, normal], [0, -LOAD])
    f = sum(c * part for c, part in zip((A, B), derivatives(x[:, 1]), strict=True))
    u = np.stack([f[1] * np.sin(K * x[:, 0]), -K * f[0] * np.cos(K * x[:, 0])], axis=1)
    return u, -SHEAR / K * (f[3] - K**2 * f[1]) * np.cos(K * x[:, 0])


@cache
def layer(cells, damping=1.0, ghost=1.0, filled=0.5):
    """Return displacement, pressure, their exact values, and the cell pressure, at the points of the layer.

    The top row of cells is partly filled.
    """
    h = 1 / (cells - 1 + filled)
    grid = mpm.Grid([0, 0], [1, (cells + 1) * h], [cells, cells + 1])
    body = mpm.box(grid, [0, 0], [1, 1])
    x = np.linspace(0, 1, 2 * cells + 1)
    load = -LOAD * np.diff(np.sin(K * x)) / (K * np.diff(x))
    tractions = [
        mpm.Traction("top", (0, q), region=((a, 0), (b, 2))) for q, a, b in zip(load, x[:-1], x[1:], strict=True)
    ]
    soil = Soil(bulk=2 * SHEAR / 3, shear=SHEAR)
    walls = {"left": "x", "right": "x", "bottom": "y"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Soil, "strength", damping)
        patch.setattr("mpm_dolfinx.mechanics.ghost_penalty.GHOST", ghost * GHOST)
        s = mpm.Simulation(grid, [body], [soil], fluid=mpm.Fluid(bulk=np.inf), walls=walls, conditions=tractions)
        s.run(1.0, 1.0, progress=False)
    cells_pressure = s.scene.storage.p.x.array[s.grid.locals[s.grid.number(s.grid.index(body.centre))]]
    return s.points.corners.mean(axis=1) - body.centre, s.points.pressure, *exact(body.centre), cells_pressure


def rms(values):
    return np.sqrt(np.mean(values**2))


def errors(which, **options):
    """Return the relative errors of displacement (0) or pressure (1)."""
    solutions = [layer(cells, **options) for cells in CELLS]
    return np.array([rms(s[which] - s[2 + which]) / rms(s[2 + which]) for s in solutions])


def changes(which, filled=0.5, **options):
    """Return the relative change of displacement or cell pressures with another strength of the damping."""
    changed = (0, 4)[which]
    pairs = [(layer(cells, filled=filled), layer(cells, filled=filled, **options)) for cells in CELLS]
    return np.array([rms(a[changed] - b[changed]) / rms(a[2 + which]) for a, b in pairs])


def orders(values):
    return np.log2(values[:-1] / values[1:])


def test_undrained_displacement_is_of_second_order_and_pressure_of_nearly_as_much():
    assert orders(errors(0)).min() > 1.9 and errors(0)[-1] < 1.1e-3
    assert orders(errors(1)).min() > 1.4 and errors(1)[-1] < 2.5e-3  # the damping's


@pytest.mark.parametrize("strength, share", [(0.25, 0.6), (4.0, 2.3)])
def test_what_the_damping_changes_vanishes_as_fast_as_the_error(strength, share):
    u, p = changes(0, damping=strength), changes(1, damping=strength)
    assert orders(u).min() > 1.9 and (u < share * errors(0)).all()
    assert orders(p).min() > 1.2


@pytest.mark.parametrize("strength, share", [(0.1, 0.15), (10.0, 0.45)])
def test_what_the_ghost_penalty_changes_vanishes_faster_than_the_error(strength, share):
    u, p = changes(0, 0.1, ghost=strength), changes(1, 0.1, ghost=strength)
    assert orders(u).min() > 2.3 and (0 < u).all() and (u < share * errors(0, filled=0.1)).all()
    assert orders(p).min() > 1.2


def pushed(monkeypatch, most, law=mpm.DruckerPrager, **strength):
    """Return load and pressures (columns, rows), in Pa, under a footing in an undrained layer of flat cells."""
    monkeypatch.setattr("mpm_dolfinx.materials.evaluate.MOST", most)
    grid = mpm.Grid(lower=[0, -1], upper=[1.6, 0.2], cells=[24, 6])
    soil = law(bulk=13 / 6 * 1e8, shear=1e8, **strength)
    under, beside = ((0, -1), (7 / 15, 1)), ((7 / 15, -1), (2, 1))
    foot = mpm.Displacement("top", lambda t, X: (0, -6e-4 * t), region=under)
    walls, open_side = {"left": "x", "right": "x", "bottom": "xy"}, mpm.Drained("top", region=beside)
    scene = {"walls": walls, "fluid": mpm.Fluid(), "conditions": [open_side, foot]}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, -1], [1.6, 0])], [soil], **scene)
    s.run(1.0, 0.05)
    cells = s.cells()
    p = np.zeros((24, 6))
    p[tuple(grid.index(cells.x).T)] = cells.pressure
    return s.reactions.array[0, 1], p[:, :5]


def test_pressures_do_not_alternate_where_soil_flows(monkeypatch):
    """The cells are three times as high as wide. The load of the footing does not change."""
    (_, plain), (load, p) = (
        pushed(monkeypatch, most, friction=0.0, dilation=0.0, cohesion=1e4) for most in (1.0, MOST)
    )
    rest, most = (rms(alternating(part)) / 1e4 for part in (p, plain))
    print(f"rms of what alternates, over c: {rest:.3f}, without more damping {most:.3f}")
    assert most > 0.15 and rest < 0.05
    assert load == pytest.approx(-(2 + np.pi) * 1e4 * 0.5, rel=0.1)


def test_what_damps_soft_soil_meets_no_even_gradient_and_loses_no_fluid():
    """Pressures that alternate along both axes are damped as by damping of jumps, away from the sides."""
    grid = mpm.Grid([0, 0], [6.0, 4.0], [6, 4])
    cells, index, rng = np.arange(grid.num_local), grid.index_from_base(grid.midpoints), np.random.default_rng(0)
    own, opening = Unknowns(fem.Function(grid.cellwise()), cells), np.ones((grid.num_local, 2, 2))
    shift = rng.uniform(-0.2, 0.2, size=6)[index[:, :1]] * [1, 0]  # of centroids
    H = second_differences(own, grid, rng.uniform(1, 9, size=(len(cells), 2)), shift, opening)
    even = own.gather_owned((grid.midpoints + shift)[:, 0])
    assert np.abs((H * even).array).max() < 1e-12
    assert abs((H * own.gather_owned(rng.normal(size=len(cells)))).array.sum()) < 1e-11
    H = second_differences(own, grid, np.ones((len(cells), 2)), 0 * shift, opening)
    signs = 1.0 - 2 * (index.sum(axis=1) % 2)
    inner = (index[:, 0] == 2) | (index[:, 0] == 3)
    force = (H * own.gather_owned(signs)).array / signs
    assert force[inner & (index[:, 1] % 3 != 0)] == pytest.approx(4 + 3)  # a jump: 4 along each axis; y has 2 rows
    with_gap = opening.copy()
    with_gap[index[:, 0] == 2, 0, 1] = 0.0
    H = second_differences(own, grid, np.ones((len(cells), 2)), 0 * shift, with_gap)
    step = own.gather_owned((index[:, 0] > 2).astype(float))
    assert np.abs((H * step).array).max() < 1e-12, "what does not touch is not coupled"


def test_soil_that_could_yield_and_does_not_is_damped_as_elastic_soil(monkeypatch):
    strength = {"friction": 0.0, "dilation": 0.0, "cohesion": 1e9}
    (one, plain), (other, p) = (pushed(monkeypatch, most, **strength) for most in (1.0, MOST))
    assert other == pytest.approx(one, rel=1e-5) and np.abs(p - plain).max() < 1e-4 * np.abs(plain).max()


def pressed(times):
    """Return the softness after each step, and the final positions, of yielding undrained sand under two loads."""
    grid = mpm.Grid([0, 0], [0.4, 0.5], [4, 5])
    sand = mpm.DruckerPrager(1e7, 1e7, friction=20.0, dilation=0.0, cohesion=1e2, conductivity=0.0)
    first = mpm.Traction("top", lambda t: (0, -2e4 * np.interp(t, [0, *times], [0, 1, 1, 1])))
    then = mpm.Traction("top", lambda t: (0, -2e4 * np.interp(t, [0, *times], [0, 0, 0, 1])), region=((0, 0), (0.2, 1)))
    body, softness = [mpm.box(grid, [0, 0], [0.4, 0.4])], []
    options = {"walls": {"left": "x", "right": "x", "bottom": "y"}, "conditions": [first, then]}
    s = mpm.Simulation(grid, body, [sand], fluid=mpm.Fluid(bulk=1e6), **options)
    s.run(times[-1], 1.0, observe=lambda s: softness.append(s.points.data["softness"]), progress=False)
    return softness, s.points.x


def test_a_step_at_rest_changes_nothing():
    """The strain is rounding. Its direction would make soil on the yield surface stiff, or a hundred times as soft."""
    (flows, rests, last), x = pressed([1, 2, 3])
    (first, alone), y = pressed([1, 1, 2])
    assert 2 < flows.min() and flows.max() < 50
    assert rests == pytest.approx(flows, rel=1e-6) and first == pytest.approx(flows)
    assert alone == pytest.approx(last, rel=1e-5)
    np.testing.assert_allclose(x, y, rtol=0, atol=1e-11)


def test_only_points_in_water_of_laws_with_a_state_carry_their_softness():
    grid, walls = mpm.Grid([0, 0], [0.2, 0.4], [2, 4]), {"left": "x", "right": "x", "bottom": "y"}
    sand = mpm.DruckerPrager(1e7, 5e6, friction=0.0, dilation=0.0, cohesion=1e3)
    for soil, fluid in ((mpm.Hencky(1e7, 5e6), mpm.Fluid()), (sand, None), (sand, mpm.Fluid())):
        s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [0.2, 0.3])], [soil], fluid=fluid, walls=walls)
        assert ("softness" in s.points.data) == bool(soil.state and fluid)
