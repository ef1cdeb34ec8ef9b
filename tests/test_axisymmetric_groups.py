# SPDX-License-Identifier: MIT
"""Contact of bodies of revolution: patch test, Lamé's tubes, symmetry, friction on a shaft, momentum, and restart."""

import numpy as np
import pytest

import mpm_dolfinx as mpm

E = 1e6  # Pa
SOIL = mpm.Hencky(bulk=E / 3, shear=E / 2, porosity=0.4, conductivity=1e-5, grain_density=2000)  # nu = 0
TURN = 2 * np.pi


@pytest.mark.parametrize(("offset", "order", "spacings"), [(0.0, 1, (2, 3)), (0.3, -1, (2, 2)), (0.7, 1, (3, 2))])
def test_discs_under_pressure_press_each_other_evenly(offset, order, spacings):
    grid, y = mpm.Grid([0, 0], [1, 2], [8, 16], axisymmetric=True), 0.5 + offset / 8
    bodies = [
        mpm.box(grid, *box, per_cell=n)
        for box, n in zip(([[0, 0], [1, y]], [[0, y], [1, 0.98]]), spacings, strict=True)
    ]
    press = mpm.Traction("top", (0, -1e4), region=([0, 0.95], [1, 1.1]))
    conditions = [press, mpm.Contact(*(0, 1)[::order], friction=0.3)]
    s = mpm.Simulation(grid, bodies, [SOIL], walls={"bottom": "y", "right": "x"}, conditions=conditions)
    s.step(1.0)
    assert s.effective_stress()[:, 1, 1] == pytest.approx(np.full(len(s.points), -1e4), rel=1e-8)
    assert s.tool_forces.array[0, :2] == pytest.approx([0, -order * np.pi * 1e4], rel=1e-8, abs=1e-6)


def in_sleeve(n, stiff, inner=0.43, outer=0.9, p=100.0):
    """Return the radial force on a core in a sleeve under pressure, without axial strain, and the exact force."""
    grid = mpm.Grid([0, 0], [1 + 2 / n, 2 / n], [n + 2, 2], axisymmetric=True)
    core = mpm.box(grid, [0, 0], [inner, 2 / n])
    sleeve = mpm.box(grid, [inner, 0], [outer, 2 / n], per_cell=3, material=1)
    press = mpm.Traction("right", (-p, 0), region=([0.8, 0], [1.2, 1]))
    soils = [mpm.Hencky(bulk=stiff * E / 3, shear=stiff * E / 2), SOIL]
    walls = {"bottom": "y", "top": "y"}
    s = mpm.Simulation(grid, [core, sleeve], soils, walls=walls, conditions=[press, mpm.Contact(0, 1)])
    for _ in range(2):
        s.step(1.0)  # the contact pressures of the first step remain in the second
    # displacement of the sleeve's inner side: u = (A r + B / r) / E, sigma_r = A - B / r^2; of the core's: -q r / (k E)
    a, b = inner, outer
    matrix = [[1, -1 / a**2, 1], [1, -1 / b**2, 0], [a, 1 / a, a / stiff]]
    q = np.linalg.solve(matrix, [0, -p, 0])[2]
    return s.tool_forces.array[0, 0], -q * TURN * inner * 2 / n


@pytest.mark.parametrize("stiff", [10.0, 0.1])
def test_core_in_a_sleeve_carries_the_pressure_of_lame(stiff):
    errors = [abs(np.divide(*in_sleeve(n, stiff)) - 1) for n in (8, 16)]
    assert errors[0] < 5e-4
    assert errors[0] / errors[1] > 2


def dome(grid, sign):
    """Return half of a ball with radius 0.8 m, above or below the plane z = 1 m, which touches its pole."""
    angle = np.linspace(0, np.pi / 2, 25)[::sign]
    arc = np.column_stack([0.8 * np.sin(angle), 1 + sign * (0.8 - 0.8 * np.cos(angle))])
    corners = np.vstack([arc, [[0, 1 + sign * 0.8]] if sign > 0 else [[0, 0.2]]])
    if sign < 0:
        corners = np.vstack([[[0, 0.2]], arc])
    return mpm.polygon(grid, corners, "side")


def test_equal_balls_meet_like_a_ball_and_a_rigid_plane():
    grid = mpm.Grid([0, 0], [1, 2], [16, 32], axisymmetric=True)
    forces = []
    for pair in (True, False):
        bodies = [dome(grid, 1), dome(grid, -1)] if pair else [dome(grid, 1)]
        ends = [
            mpm.Displacement("side", lambda t, up=up: (0, -0.05 * up * t), "y", region=([0, low], [1, low + 0.25]))
            for up, low in ((1, 1.75), (-1, 0.0))[: len(bodies)]
        ]
        other = mpm.Contact(0, 1) if pair else mpm.Tool(mpm.HalfSpace([0, 1], [0, 1]))
        s = mpm.Simulation(grid, bodies, [SOIL], walls={"left": "x"}, conditions=[*ends, other])
        s.run(1.0, 0.25)
        forces.append(s.tool_forces.array[0, 1])
    assert forces[0] == pytest.approx(forces[1], rel=5e-3)  # 1.1, 0.3, 0.2 % apart with 8, 16, 32 cells


def test_shaft_slips_in_its_sleeve_at_the_friction_angle():
    """A core is pushed through a sleeve with friction. The ends of the sleeve bulge, so r is not exactly the normal."""
    grid, r = mpm.Grid([0, 0], [1.25, 2], [10, 16], axisymmetric=True), 0.43
    core, sleeve = mpm.box(grid, [0, 0.2], [r, 1.8]), mpm.box(grid, [r, 0.6], [0.9, 1.4], per_cell=3)
    conditions = [
        mpm.Traction("right", (-1e3, 0), region=([0.8, 0], [1.2, 2])),
        mpm.Displacement("bottom", (0, 0), "y", region=([r - 1e-9, 0.55], [1, 0.65])),
        mpm.Displacement("top", lambda t: (0, -0.02 * max(t - 1, 0)), "y", region=([0, 1.75], [r + 1e-9, 1.85])),
        mpm.Contact(0, 1, friction=0.3),
    ]
    s = mpm.Simulation(grid, [core, sleeve], [SOIL], walls={"left": "x"}, conditions=conditions)
    for step in range(4):
        s.step(1.0)
        normal, along, turn = s.tool_forces.array[0]
        if step:
            assert along == pytest.approx(-0.3 * normal, rel=1e-3)
        assert turn == 0
        assert s.reactions.array[:, 1] == pytest.approx([along, -along], rel=1e-8, abs=1e-6)
    assert -normal == pytest.approx(TURN * r * 0.8 * 1e3, rel=0.1)  # the core bears more than at uniform pressure


def test_discs_that_strike_each_other_keep_their_momentum():
    grid = mpm.Grid([0, 0], [1, 4], [8, 32], axisymmetric=True)
    bodies = [mpm.box(grid, [0, 1.03], [0.43, 1.6]), mpm.box(grid, [0, 1.65], [0.6, 2.2], per_cell=3)]
    conditions, walls = [mpm.Contact(0, 1, friction=0.2)], {"left": "x"}

    def velocity(x):
        return np.column_stack([0 * x[:, 0], np.where(x[:, 1] > 1.62, -1.0, 1.0)])

    s = mpm.Simulation(grid, bodies, [SOIL], walls=walls, conditions=conditions, inertia=mpm.Moving(velocity))
    mass, momenta, forces = s.scene.materials.density(s.points) * s.points.volume0 * s.points.J, [], []
    for _ in range(40):
        s.step(2.5e-3)
        momenta.append(mass @ s.points.velocity[:, 1])
        forces.append(s.tool_forces.array[0, 1])
    assert min(forces) < -1e3 and forces[-1] == 0  # they strike and part
    assert np.ptp(momenta) < 1e-12 * mass.sum()


def test_wet_discs_resume_bit_for_bit_and_keep_their_fluid(tmp_path):
    def scene():
        grid = mpm.Grid([0, 0], [1, 2], [4, 8], axisymmetric=True)
        bodies = [mpm.box(grid, [0, 0], [0.9, 0.55]), mpm.box(grid, [0, 0.55], [0.6, 1.1], per_cell=3)]
        press = mpm.Traction("top", lambda t: (0, -1e4 * t / 600), region=([0, 1], [1, 2]))
        conditions = [press, mpm.Drained("right", region=([0.8, 0], [1, 1])), mpm.Contact(0, 1, friction=0.3)]
        walls = {"bottom": "y", "left": "x"}
        return mpm.Simulation(grid, bodies, [SOIL], walls=walls, conditions=conditions, fluid=mpm.Fluid())

    whole, parts, resumed = scene(), scene(), scene()
    whole.run(600.0, 100.0)
    parts.run(300.0, 100.0, checkpoint=mpm.Checkpoint(tmp_path / "half.npz"))
    resumed.run(600.0, 100.0, after=mpm.resume(resumed, tmp_path / "half.npz"))
    assert all(a.tobytes() == b.tobytes() for a, b in zip(whole.points.arrays, resumed.points.arrays, strict=True))
    assert whole.tool_forces.array[0, 1] == pytest.approx(-np.pi * 0.36 * 1e4, rel=1e-6)
    assert whole.result.balance < 1e-8
