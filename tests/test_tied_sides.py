# SPDX-License-Identifier: MIT
"""Ground of finite width between tied sides responds as ground of infinite width."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

YOUNG, NU, RHO = 50e6, 0.3, 1890.0
SOIL = mpm.LinearElastic(bulk=YOUNG / 3 / (1 - 2 * NU), shear=YOUNG / 2 / (1 + NU), grain_density=2700.0, porosity=0.3)
MODULUS = SOIL.bulk + 4 / 3 * SOIL.shear
C_P, C_S = np.sqrt(MODULUS / RHO), np.sqrt(SOIL.shear / RHO)
HEIGHT, OFF = 10.0, 0.37  # m, and cells between the base and a grid line
TIED = mpm.Tied("left", "right")


def layer(n, width, base, begins=0.5, conditions=(TIED,), **options):
    """Return a layer between tied sides, n cells high and some cells wide."""
    h = HEIGHT / n
    grid = mpm.Grid([0, 0], [(width + 2) * h, HEIGHT + 3 * h], [width + 2, n + 3])
    body = mpm.box(grid, [begins * h, (1 + OFF) * h], [(begins + width) * h, HEIGHT + (1 + OFF) * h])
    return mpm.Simulation(grid, [body], [SOIL], walls={}, conditions=[base, *conditions], **options)


@pytest.mark.parametrize("begins", [0.0, 0.5])
def test_a_slope_of_finite_width_settles_and_shears_as_an_infinite_one(begins):
    """Exact: rho g H^2 / 2 divided by each modulus, and the stress of an infinite layer everywhere."""
    s = layer(16, 3, mpm.Displacement("bottom", (0, 0)), begins, gravity=(2.0, -9.81))
    s.run(1.0, 0.5, progress=False)
    top, u = s.points.x[:, 1].argmax(), s.points.displacement
    weight = RHO * HEIGHT**2 / 2
    assert u[top] == pytest.approx([2.0 * weight / SOIL.shear, -9.81 * weight / MODULUS], rel=2e-3)
    stress, depth = s.effective_stress(), HEIGHT + (1 + OFF) * HEIGHT / 16 - s.points.origin.mean(axis=1)[:, 1]
    most = RHO * 9.81 * HEIGHT
    assert stress[:, 0, 0] == pytest.approx(-NU / (1 - NU) * RHO * 9.81 * depth, abs=3e-3 * most)
    assert stress[:, 0, 1] == pytest.approx(RHO * 2.0 * depth, abs=3e-3 * most)


@pytest.mark.parametrize("gravity, warned", [((0, -9.81), False), ((3.4, -9.2), True)])
def test_a_slope_in_which_water_would_flow_on_is_warned_of(gravity, warned, recwarn):
    """Pressures between the tied sides became those of water at rest in inclined gravity, without a warning."""
    grid = mpm.Grid([0, 0], [1.0, 1.2], [5, 6])
    soil = mpm.Hencky(bulk=2e6, shear=1e6, conductivity=1e-4)
    body, options = mpm.box(grid, [0.2, 0], [0.8, 1.0]), {"walls": {"bottom": "xy"}, "gravity": gravity}
    for fluid in (None, mpm.Fluid()):
        mpm.Simulation(
            grid, [body], [soil], fluid=fluid, conditions=[TIED, mpm.Drained("top")][: 1 + bool(fluid)], **options
        )
        assert any("through tied sides" in str(one.message) for one in recwarn) == (warned and fluid is not None)


def test_soil_at_rest_keeps_its_horizontal_stress_between_tied_sides():
    s = layer(8, 2, mpm.Displacement("bottom", (0, 0)), gravity=(0, -9.81), initial_stress=mpm.K0(0.5))
    s.run(1.0, 0.5, progress=False)
    stress = s.effective_stress()
    assert stress[:, 0, 0] == pytest.approx(stress[:, 1, 1] / 2, abs=3e-3 * np.abs(stress).max())
    assert np.abs(s.points.displacement).max() < 1e-9 * HEIGHT


@pytest.mark.parametrize("width", [2, 5])
def test_a_layer_of_finite_width_shakes_as_an_infinite_one(width):
    """Exact: standing shear and pressure waves between the surface and a base that moves in both directions."""
    n, steps, amplitude = 16, 40, np.array([1e-3, 5e-4])
    w, top = 0.3 * np.pi * C_S / HEIGHT, HEIGHT + (1 + OFF) * HEIGHT / n

    def shape(x):
        up = top - x[:, 1:]
        return amplitude * np.cos(w * up / [C_S, C_P]) / np.cos(w * HEIGHT / np.array([C_S, C_P]))

    base = mpm.Displacement("bottom", lambda t: amplitude * np.sin(w * t))
    s = layer(n, width, base, inertia=mpm.Moving(lambda x: w * shape(x)))
    exact, off = shape(s.points.x), []

    def look(s):
        off.append(np.abs(s.points.displacement - exact * np.sin(w * s.t)).max(axis=0) / exact.max(axis=0))

    e = s.run(2 * np.pi / w, 2 * np.pi / w / steps, energies=True, observe=look, progress=False).energies
    assert (np.max(off, axis=0) < 0.01).all()
    total = e["kinetic"] + e["elastic"] + e["dissipated"] - e["external"]
    assert np.abs(total - total[0]).max() < 3e-3 * e["kinetic"].max()


def test_a_pulse_that_leaves_on_one_side_enters_on_the_other():
    """Exact: after a run through its width the layer has its initial velocity, also after a translation."""
    n, width = 1, 40
    h = HEIGHT / n / 10
    grid = mpm.Grid([0, 0], [(width + 2) * h, h], [width + 2, 1])
    body = mpm.box(grid, [0.5 * h, 0], [(0.5 + width) * h, h])

    def velocity(x):
        return np.stack([1e-2 * np.cos(2 * np.pi * x[:, 0] / (width * h)), 0 * x[:, 0]], axis=1)

    walls = {"bottom": "y", "top": "y"}
    s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[TIED], inertia=mpm.Moving(velocity))
    before = s.points.velocity.copy()
    s.run(width * h / C_P, h / C_P, progress=False)
    assert s.points.velocity == pytest.approx(before, abs=0.01 * np.abs(before).max())


def test_tied_sides_are_refused_unless_they_are_opposite_and_alike():
    base = mpm.Displacement("bottom", (0, 0))
    with pytest.raises(ValueError, match=r"must be opposite sides of a body from mpm\.box"):
        layer(4, 3, base, conditions=[mpm.Tied("left", "top")])
    with pytest.raises(ValueError, match=r"must be opposite sides of a body from mpm\.box"):
        layer(4, 3, base, conditions=[mpm.Tied("left", "left")])
    with pytest.raises(ValueError, match="middle"):
        layer(4, 3, base, conditions=[mpm.Tied("left", "middle")])


@pytest.mark.parametrize(
    "other", [mpm.Tied("right", "left"), mpm.Quiet("right"), mpm.Drained("left"), mpm.Rain("right", 1e-6)]
)
def test_a_tied_side_has_no_other_tie_and_no_way_out_for_waves_or_water(other):
    base, fluid = mpm.Displacement("bottom", (0, 0)), mpm.Fluid()
    with pytest.raises(ValueError, match=r"Tied\(.* and .*: both act at"):
        layer(4, 3, base, conditions=[TIED, other], fluid=fluid, inertia=True)
