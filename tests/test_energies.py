# SPDX-License-Identifier: MIT
"""Energies and works balance, and each energy has its exact value."""

import numpy as np
import pytest
from test_waves import C_P, HEIGHT, RHO, SOIL, column, pulse

import mpm_dolfinx as mpm

CLAY = mpm.DruckerPrager(bulk=2e5, shear=1e5, friction=0.0, dilation=0.0, cohesion=2e3, grain_density=2700.0)


def off(result):
    """Return the error of the energy balance, divided by the largest energy."""
    e = result.energies
    total = e["kinetic"] + e["elastic"] + e["dissipated"] + e["viscous"] - e["external"]
    return np.abs(total - total[0]).max() / max(np.abs(values).max() for values in e.values())


def test_what_a_pulse_brings_leaves_through_a_quiet_base():
    """Exact: int q^2 / (rho c) dt, with q sin^2 in time, is 3/8 of the value for a constant load."""
    load = mpm.Traction("top", lambda t: (0, -1e3 * pulse(t, 0.1)))
    s = column(conditions=[load, mpm.Quiet("bottom")])
    result = s.run(0.18, HEIGHT / 20 / C_P, energies=True, progress=False)
    e, brought = result.energies, 3 / 8 * 1e6 * 0.1 / (RHO * C_P) * HEIGHT / 20
    assert e["external"][-1] == pytest.approx(brought, rel=2e-3)
    assert e["viscous"][-1] == pytest.approx(brought, rel=2e-3)
    assert e["kinetic"][-1] + e["elastic"][-1] < 1e-5 * brought and off(result) < 3e-4


def test_energies_of_a_column_that_vibrates_under_its_weight_on_a_base_that_moves_balance():
    """Dissipation is an error here: the work of stresses minus the energy of the law, of second order."""
    base, lost = mpm.Displacement("bottom", lambda t: (0, 1e-3 * np.sin(30 * t) ** 2), "y"), []
    for n in (5, 10):
        s = column(n, [base], gravity=(0, -9.81))
        result = s.run(0.3, HEIGHT / n / C_P, energies=True, progress=False)
        lost.append([off(result), np.abs(result.energies["dissipated"]).max() / result.energies["elastic"].max()])
    assert lost[0][0] < 3e-3 and lost[0][1] < 1e-2 and (np.array(lost[0]) > 2.5 * np.array(lost[1])).all()


def test_a_block_that_falls_gains_what_its_weight_does():
    grid = mpm.Grid([0, 0], [1, 4], [5, 20])
    block = mpm.box(grid, [0.3, 3.1], [0.7, 3.5])
    s = mpm.Simulation(grid, [block], [SOIL], walls={}, gravity=(0, -9.81), inertia=mpm.Moving((0.1, 0.3)))
    e = s.run(0.5, 0.05, energies=True, progress=False).energies
    drop = RHO * 0.4**2 * 9.81 * (9.81 / 8 - 0.15)
    assert e["external"][-1] == pytest.approx(drop, rel=1e-9)
    assert e["kinetic"][-1] - e["kinetic"][0] == pytest.approx(drop, rel=1e-9)
    assert e["kinetic"][0] == pytest.approx(RHO * 0.4**2 * 0.1 / 2, rel=1e-9)
    assert not e["renewal"].any(), "all energies of `Result.energies` exist, also without renewal"
    with pytest.raises(KeyError, match="'friction_1': must be one of 'kinetic', 'elastic'"):
        e["friction_1"]
    with pytest.raises(KeyError, match="'kinetic': must be one of the names of results, but there are none"):
        s.run(0.6, 0.05, progress=False).energies["kinetic"]


def test_a_block_of_moist_soil_gains_what_its_own_weight_does():
    """The pores are half full. With the weight of saturated soil, the block would gain a ninth more energy."""
    grid = mpm.Grid([0, 0], [1, 4], [5, 20])
    block = mpm.box(grid, [0.3, 3.1], [0.7, 3.5])
    law = {"porosity": 0.4, "grain_density": 2600.0, "retention": mpm.VanGenuchten(1e4, n=2.0), "conductivity": 1e-6}
    soil = mpm.Hencky(bulk=2e7, shear=1e7, **law)
    options = {"walls": {}, "gravity": (0, -9.81), "inertia": True, "pressure": lambda x: -np.sqrt(3) * 1e4}
    s = mpm.Simulation(grid, [block], [soil], fluid=mpm.Fluid(), **options)
    result = s.run(0.5, 0.025, energies=True, progress=False)
    drop = (0.6 * 2600 + 0.4 * 0.5 * 1000) * 0.4**2 * 9.81**2 / 8
    assert result.energies["external"][-1] == pytest.approx(drop, rel=1e-3) and off(result) < 5e-3


def test_soil_that_yields_dissipates_what_is_lost():
    """A wall of clay is thrown to the side on its foot, and comes to rest. Its stresses store the energy of Hencky's
    law.
    """
    grid = mpm.Grid([0, 0], [2.4, 1.2], [16, 8])
    wall = mpm.box(grid, [0.6, 0], [1.2, 0.9])
    velocity = lambda x: np.stack([2 * x[:, 1], 0 * x[:, 1]], axis=1)  # noqa: E731
    s = mpm.Simulation(grid, [wall], [CLAY], walls={"bottom": "xy"}, inertia=mpm.Moving(velocity))
    result = s.run(0.25, 0.01, energies=True, progress=False)
    e = result.energies
    assert (np.diff(e["dissipated"]) > -1e-3 * e["kinetic"][0]).all() and e["dissipated"][-1] > 0.3 * e["kinetic"][0]
    assert off(result) < 1e-2 and (e["external"] == 0).all() and e["elastic"].min() >= 0


def test_energies_of_a_wet_column_balance():
    soil = mpm.Hencky(bulk=4e7, shear=2e7, conductivity=1e-3)
    grid = mpm.Grid([0, 0], [1, 12], [1, 12])
    options = {"fluid": mpm.Fluid(bulk=1e9), "walls": {"left": "x", "right": "x", "bottom": "y"}, "inertia": True}
    conditions = [mpm.Drained("top"), mpm.Traction("top", lambda t: (0, -1e4 * min(t / 0.05, 1)))]
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 10])], [soil], conditions=conditions, **options)
    result = s.run(0.1, 0.005, energies=True, progress=False)
    assert off(result) < 5e-3 and result.energies["dissipated"][-1] > 0


def test_a_run_that_goes_on_counts_on(tmp_path):
    def scene():
        return column(6, [mpm.Displacement("bottom", (0, 0))], gravity=(0, -9.81))

    one, other = scene(), scene()
    first = one.run(0.04, 0.01, energies=True, checkpoint=mpm.Checkpoint(tmp_path / "run.npz"), progress=False)
    resumed = mpm.resume(other, tmp_path / "run.npz")
    found = [
        s.run(0.08, 0.01, energies=True, after=result, progress=False).energies
        for s, result in ((one, first), (other, resumed))
    ]
    assert all(np.array_equal(found[0][name], found[1][name]) for name in found[0])
    fresh = one.run(0.1, 0.01, energies=True, progress=False).energies
    assert fresh["external"][0] == 0 and found[0]["external"][4] != 0


def test_energies_are_not_measured_unless_they_are_asked_for():
    s = column(4)
    assert s.run(0.01, 0.01, progress=False).energies == {}
    assert not any("_energy" in vars(law) for law in s.scene.materials._at_points)
    still = column(4, inertia=False)
    with pytest.raises(ValueError, match="no inertia"):
        still.run(1.0, 1.0, energies=True)
    with pytest.raises(ValueError, match="energies"):
        s.run(1.0, 1.0, energies=1)
