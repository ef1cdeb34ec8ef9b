# SPDX-License-Identifier: MIT
"""Waves leave through quiet sides, which keep their tractions at rest; bases move as prescribed."""

import warnings
import wave

import numpy as np
import pytest

import mpm_dolfinx as mpm

YOUNG, NU, RHO = 50e6, 0.3, 1890.0
SOIL = mpm.LinearElastic(bulk=YOUNG / 3 / (1 - 2 * NU), shear=YOUNG / 2 / (1 + NU), grain_density=2700.0, porosity=0.3)
C_P, C_S = np.sqrt((SOIL.bulk + 4 / 3 * SOIL.shear) / RHO), np.sqrt(SOIL.shear / RHO)  # 188.7 and 100.9 m/s
HEIGHT, OFF = 10.0, 0.37  # m, and cells between the base and a grid line
SMOOTH = {"left": "x", "right": "x"}


def column(n=20, conditions=(), walls=SMOOTH, **options):
    """Return a column of n cells, one cell wide, with its base in the middle of a cell."""
    h = HEIGHT / n
    grid = mpm.Grid([0, 0], [h, HEIGHT + 3 * h], [1, n + 3])
    body = mpm.box(grid, [0, (1 + OFF) * h], [h, HEIGHT + (1 + OFF) * h])
    return mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=conditions, **{"inertia": True, **options})


def speed(s):
    return np.abs(s.points.velocity).max()


def pulse(t, length=0.05):
    """Return a smooth pulse of height 1 in a time (s)."""
    return np.sin(np.pi * t / length) ** 2 * (0 < t < length)


def layer(n, conditions, inertia=True, **options):
    """Return a layer on a grid with room for its motion, fixed along y on both sides as an infinite layer."""
    h = HEIGHT / n
    grid = mpm.Grid([0, 0], [3 * h, HEIGHT + 3 * h], [3, n + 3])
    body = mpm.box(grid, [0.5 * h, (1 + OFF) * h], [2.5 * h, HEIGHT + (1 + OFF) * h])
    level = [mpm.Displacement(side, (0, 0), "y") for side in ("left", "right")]
    return mpm.Simulation(grid, [body], [SOIL], walls={}, inertia=inertia, conditions=[*conditions, *level], **options)


@pytest.mark.parametrize(("axis", "c", "scene"), [(1, C_P, column), (0, C_S, layer)], ids=["pressure", "shear"])
def test_a_wave_leaves_through_a_quiet_base(axis, c, scene):
    """Exact: particles move by q / (rho c) while the wave passes, and then rest. 40 cells per wave."""
    length = 40 * HEIGHT / 20 / c
    load = mpm.Traction("top", lambda t: -1e3 * pulse(t, length) * np.eye(2)[axis])
    s, fastest = scene(20, [load, mpm.Quiet("bottom")]), 0.0
    for _ in range(68):
        s.step(HEIGHT / 20 / c)
        fastest = max(fastest, speed(s))
    assert fastest == pytest.approx(1e3 / RHO / c, rel=0.01) and speed(s) < 1e-3 * fastest
    assert s.points.displacement[:, axis] == pytest.approx(-1e3 / RHO / c * length / 2, rel=0.01)


def test_a_sudden_load_runs_to_a_rigid_base_and_back():
    """Exact: a triangle in time at the top; at the base 0 until L / c, then twice the load until 3 L / c, c dt = h."""
    n, q = 40, 1e3
    s = column(n, [mpm.Traction("top", (0, -q)), mpm.Displacement("bottom", (0, 0), "y")])
    top = mpm.probes(s.bodies, [[HEIGHT / n / 2, HEIGHT + (1 + OFF) * HEIGHT / n]])
    result = s.run(4 * HEIGHT / C_P, HEIGHT / n / C_P, probes=top, progress=False)
    t, most = result.t * C_P / HEIGHT, 2 * q * HEIGHT / (SOIL.bulk + 4 / 3 * SOIL.shear)
    assert -result.displacement[:, 0, 1] == pytest.approx(most * np.minimum(t, 4 - t) / 2, abs=0.02 * most)
    stress, far = result.reactions.array[0, :, 1] / (q * HEIGHT / n), np.abs(t - 2) > 1
    away = (np.abs(np.abs(t - 2) - 1) > 0.3) & (t > 0.3)
    assert stress[away] == pytest.approx(2.0 * ~far[away], abs=0.02 * 2)


@pytest.mark.slow
def test_saturated_columns_converge_under_loads_that_swing_or_come_at_once():
    """Exact u-p solutions of the demo `wave`, at (1, 0.1) and for stiff water and grains: second order."""
    c2 = (wave.MODULUS + 1 / wave.STORED) / wave.MIXED
    w = np.sqrt(0.1 * c2) / wave.LENGTH
    k = wave.GRAVITY * wave.WATER / wave.MIXED * w * wave.LENGTH**2 / c2

    def errors(n, steps, **growth):
        u, p, depth = wave.swinging(n, steps, 3, w, k, **growth)
        exact_u, exact_p = wave.harmonic(w, k, depth)
        late = wave.hard(n, 8 * steps, **growth)  # the error of the first step adds to that of the cells
        error = np.abs(late["u"] / late["exact"] - 1)[late["t"] > 0.02].max()
        p_off = np.abs(p - exact_p) / np.abs(exact_p).max()
        return np.array([abs(u / exact_u - 1), p_off[0], p_off[1:].max(), error])

    coarse, fine = errors(20, 25, growth=1.0), errors(40, 50, growth=1.0)
    assert (fine < [0.01, 0.004, 0.002, 0.01]).all() and (coarse / fine > [3.6, 3.6, 3.0, 3.6]).all()
    assert (errors(40, 50) < [0.002, 0.002, 0.002, 0.002]).all()  # cells that are finer at the drained side


def test_a_wave_that_comes_in_doubles_at_the_surface_and_leaves():
    """Exact: the surface has twice the velocity of the incoming wave, one run through the column later."""
    wave, dt = mpm.Quiet("bottom", incoming=lambda t: (0, 1e-2 * pulse(t, 0.1))), HEIGHT / 20 / C_P
    s, fastest = column(conditions=[wave]), (0.0, 0.0)
    top = s.points.x[:, 1].argmax()
    for _ in range(85):
        s.step(dt)
        fastest = max(fastest, (s.points.velocity[top, 1], s.t))
    assert fastest == (pytest.approx(2e-2, rel=0.01), pytest.approx(0.05 + HEIGHT / C_P, abs=dt))
    assert speed(s) < 1e-3 * fastest[0]


def test_a_pulse_in_a_block_leaves_through_all_of_its_sides():
    """The pulse reaches the sides at all angles."""
    n = 12
    grid = mpm.Grid([0, 0], [1 + 2 / n, 1 + 2 / n], [n + 2, n + 2])
    body, sides = mpm.box(grid, [0.6 / n] * 2, [1 + 0.6 / n] * 2), ("left", "right", "bottom", "top")

    def velocity(x):
        r = np.linalg.norm(x - 0.5 - 0.6 / n, axis=1)
        return np.stack([1e-2 * np.cos(np.pi * np.minimum(r, 0.3) / 0.6) ** 2, 0 * r], axis=1)

    conditions = [mpm.Quiet(side) for side in sides]
    s = mpm.Simulation(grid, [body], [SOIL], walls={}, inertia=mpm.Moving(velocity), conditions=conditions)
    first = speed(s)
    for _ in range(40):
        s.step(1 / n / C_P)
    assert speed(s) < 0.03 * first


def test_a_quiet_base_bears_what_it_bore_at_rest():
    """A column settles by 13.8 mm under its weight. With a quiet base, it then moves by less than 1/1000 of that."""
    moved = []
    for n in (10, 20):
        s = column(n, [mpm.Displacement("bottom", (0, 0), "y")], gravity=(0, -9.81), inertia=False)
        s.run(1.0, 1.0, progress=False)
        settled = s.points.x.copy()
        s.stage(inertia=True, conditions=[mpm.Quiet("bottom")])
        s.run(1.8, 0.02, progress=False)
        moved.append(np.abs(s.points.x - settled).max())
        assert speed(s) < 1e-7
    assert moved[0] < 2e-5 and moved[1] < 0.3 * moved[0]


def test_a_block_stays_at_rest_between_quiet_sides():
    grid = mpm.Grid([0, 0], [7, 12], [7, 12])
    block = mpm.box(grid, [1, 0.4], [6, 10.4])
    holds = [mpm.Displacement(side, (0, 0), axis) for side, axis in (("bottom", "y"), ("left", "x"), ("right", "x"))]
    s = mpm.Simulation(grid, [block], [SOIL], walls={}, gravity=(0, -9.81), conditions=holds, inertia=False)
    s.run(1.0, 1.0, progress=False)
    settled, depth = s.points.x.copy(), -s.points.displacement[:, 1].min()
    s.stage(inertia=True, conditions=[mpm.Quiet(side) for side in ("bottom", "left", "right")])
    s.run(3.0, 0.05, progress=False)
    assert np.abs(s.points.x - settled).max() < 5e-3 * depth and speed(s) < 1e-5


@pytest.mark.parametrize("kind", [pytest.param("3D", marks=pytest.mark.slow), "axisymmetry"])
def test_quiet_bases_bear_what_they_bore_in(kind):
    """A column settles under its weight, and is then put on a quiet base, as in plane strain."""
    n, d = 8, 3 if kind == "3D" else 2
    h, e = HEIGHT / n, np.eye(d)[-1]
    size = np.full(d, h)
    options = {"axisymmetric": True} if d == 2 else {}
    grid = mpm.Grid(np.zeros(d), size + (HEIGHT + 2 * h) * e, [1] * (d - 1) + [n + 3], **options)
    body = mpm.box(grid, (1 + OFF) * h * e, size + (HEIGHT + OFF * h) * e)
    walls = {"left": "x", "right": "x", "front": "y", "back": "y"} if d == 3 else {"right": "x"}
    held = mpm.Displacement("bottom", np.zeros(d), "xyz"[d - 1])
    s = mpm.Simulation(grid, [body], [SOIL], walls=walls, conditions=[held], gravity=-9.81 * e, inertia=False)
    s.run(1.0, 1.0, progress=False)
    settled, depth = s.points.x.copy(), np.abs(s.points.displacement).max()
    s.stage(inertia=True, conditions=[mpm.Quiet("bottom")])
    s.run(1.4, 0.02, progress=False)
    assert np.abs(s.points.x - settled).max() < 3e-3 * depth and speed(s) < 1e-5


def test_a_base_moves_as_it_should_and_bodies_with_it():
    """A shear layer on an oscillating base: exact velocities at its base, displacements at its top; second order in
    time.
    """
    w, n, amplitude = 0.3 * np.pi * C_S / HEIGHT, 16, 1e-3
    top, period, off = HEIGHT + (1 + OFF) * HEIGHT / n, 2 * np.pi / w, []
    sway = mpm.Displacement("bottom", lambda t: (amplitude * np.sin(w * t), 0))

    def shape(x):
        return amplitude * np.cos(w * (top - x[:, 1]) / C_S) / np.cos(w * HEIGHT / C_S)

    for steps in (20, 40):
        s = layer(n, [sway], mpm.Moving(lambda x: np.stack([w * shape(x), 0 * x[:, 0]], axis=1)))
        exact, errors = shape(s.points.x), []
        ends = [s.points.x[:, 1].argmin(), s.points.x[:, 1].argmax()]
        for _ in range(steps):
            s.step(period / steps)
            v, u = s.points.velocity[ends[0], 0], s.points.displacement[ends[1], 0]
            errors.append([v / w - exact[ends[0]] * np.cos(w * s.t), u - exact[ends[1]] * np.sin(w * s.t)])
        off.append(np.abs(errors).max(axis=0) / exact[ends])
    assert (off[0] < 0.012).all() and (off[0] / off[1] > 3.4).all()


def test_a_base_follows_an_accelerogram_without_drift():
    t = np.linspace(0, 0.4, 21)
    record = mpm.Record(np.stack([t, 5 * np.sin(40 * t)], axis=1), (1, 0))
    base, sides = mpm.Displacement("bottom", record), [mpm.Displacement(x, (0, 0), "y") for x in ("left", "right")]
    grid = mpm.Grid([0, 0], [4, 4], [4, 4])
    s = mpm.Simulation(grid, [mpm.box(grid, [1, 1], [3, 3])], [SOIL], walls={}, inertia=True, conditions=[base, *sides])
    foot = np.abs(s.points.corners[:, :, 1] - 1.0) < 1e-9
    for _ in range(12):
        s.step(0.05)
        off = (s.points.corners - s.points.origin)[foot][:, 0] - record(s.t)[0]
        assert np.abs(off).max() < 5e-4 * 0.05


def test_a_record_is_integrated_exactly(tmp_path):
    """a = 6 t from 1 s on: v = 3 (t - 1)^2, u = (t - 1)^3; after 3 s the velocity is constant."""
    t = np.array([1.0, 1.4, 2.0, 3.0])
    rows = np.stack([t, 6 * (t - 1)], axis=1)
    (tmp_path / "record.txt").write_text("# time, acceleration\n" + "\n".join(f"{a}, {b}" for a, b in rows))
    for given in (rows, tmp_path / "record.txt"):
        record = mpm.Record(given, (0, 2.0))
        assert record(0.5) == pytest.approx([0, 0]) and record(1.7) == pytest.approx([0, 2 * 0.7**3])
        assert record.velocity(2.5) == pytest.approx([0, 2 * 3 * 1.5**2])
        assert record(4.0) == pytest.approx([0, 2 * (8 + 12)]) and record.acceleration(3.5) == pytest.approx([0, 0])
    speeds = mpm.Record(rows, (1.0, 0), "velocity")
    assert speeds(3.0)[0] == pytest.approx(12.0) and speeds.acceleration(2.5)[0] == pytest.approx(6.0)
    still = mpm.Record(rows, (1.0, 0), at_rest=True)
    assert still.velocity(9.0)[0] == pytest.approx(0, abs=1e-12) and still(9.0)[0] == pytest.approx(0, abs=1e-12)


def test_a_resumed_wave_has_the_same_bits(tmp_path):
    def scene():
        s = column(8, [mpm.Displacement("bottom", (0, 0), "y")], gravity=(0, -9.81), inertia=False)
        s.run(1.0, 1.0, progress=False)
        s.stage(inertia=True, conditions=[mpm.Quiet("bottom", incoming=lambda t: (0, pulse(t - 1)))])
        return s

    one, other = scene(), scene()
    one.run(1.02, 0.01, checkpoint=mpm.Checkpoint(tmp_path / "wave.npz"), progress=False)
    mpm.resume(other, tmp_path / "wave.npz")
    for s in (one, other):
        s.run(1.04, 0.01, progress=False)
    assert np.array_equal(one.points.x, other.points.x) and speed(one) > 0.1


@pytest.mark.parametrize(
    ("conditions", "options", "names"),
    [
        ([mpm.Quiet("bottom")], {"inertia": False}, "inertia=True"),
        ([mpm.Quiet("bottom"), mpm.Quiet("bottom")], {}, "both act"),
        ([mpm.Quiet("bottom", incoming=(1, 2, 3))], {}, "incoming"),
        ([mpm.Quiet("bottom")], {"initial_stress": mpm.K0(0.5), "gravity": (0, -9.81)}, "initial stress"),
        ([mpm.Quiet("middle")], {}, "middle"),
        ([mpm.Quiet("bottom"), mpm.Displacement("bottom", (0, 0))], {}, "both act"),
        ([mpm.Quiet("top")], {"top": True}, "the wall 'top' of the grid fixes the side"),
        ([mpm.Quiet("bottom")], {"gravity": (0, -9.81)}, "does not bear the weight"),
    ],
)
def test_what_is_no_quiet_side_is_refused(conditions, options, names):
    with pytest.raises(ValueError, match=names):
        if options.pop("top", False):  # a body below a wall, which fixes its side
            grid = mpm.Grid([0, 0], [1, 2], [1, 2])
            body = mpm.box(grid, [0, 1], [1, 2])
            mpm.Simulation(grid, [body], [SOIL], walls={"top": "xy"}, conditions=conditions, inertia=True)
        column(4, conditions, **options)


def test_a_side_may_be_quiet_along_what_is_free():
    rollers, walls = mpm.Displacement("bottom", (0, 0), "y"), {"left": "x"}
    column(4, [mpm.Quiet("bottom"), rollers], walls).step(0.01)


def test_a_quiet_side_does_not_bear_a_weight_that_changes():
    s = column(4, [mpm.Displacement("bottom", (0, 0), "y")], gravity=(0, -9.81), inertia=False)
    s.run(1.0, 1.0, progress=False)
    with pytest.raises(ValueError, match=r"gravity = \[0.0, -5.0\] after \[0.0, -9.81\]"):
        s.stage(inertia=True, gravity=(0, -5), conditions=[mpm.Quiet("bottom")])


@pytest.mark.parametrize("resets", [False, True])
def test_a_stage_with_inertia_warns_of_sides_that_a_displacement_moves_at_once(resets):
    """Sides that were free in the static stage have settled; their displacement counts from the start."""
    sides, base = (
        [mpm.Displacement(side, (0, 0), "y") for side in ("left", "right")],
        mpm.Displacement("bottom", (0, 0)),
    )
    h = HEIGHT / 6
    grid = mpm.Grid([0, 0], [3 * h, HEIGHT + 3 * h], [3, 9])
    body = mpm.box(grid, [0.5 * h, 1.37 * h], [2.5 * h, HEIGHT + 1.37 * h])
    scene = {"walls": {}, "conditions": [base], "gravity": (0, -9.81), "inertia": False}
    s = mpm.Simulation(grid, [body], [SOIL], **scene)
    s.run(1.0, 1.0, progress=False)
    s.stage(inertia=True, conditions=[base, *sides], reset_displacement=resets)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        s.run(1.02, 0.01, progress=False)
    jumps = [str(one.message) for one in seen if "at once" in str(one.message)]
    assert len(jumps) == (0 if resets else 2) and all("Displacement(side='" in one for one in jumps)


def test_a_side_of_moving_bodies_does_not_become_quiet():
    s = column(4, [mpm.Displacement("bottom", (0, 0))])
    with pytest.raises(ValueError, match="first stage in which"):
        s.stage(conditions=[mpm.Quiet("bottom")])


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (([[0, 1], [0, 2]], (1, 0)), "increasing"),
        (([[0, 1]], (1, 0)), "two columns"),
        (([[0, 1], [1, np.nan]], (1, 0)), "finite"),
        (([[0, 1], [1, 2]], (1,)), "direction"),
        (([[0, 1], [1, 2]], (1, 0), "displacement"), "quantity"),
        (([[0, 1], [1, 2]], (1, 0), "velocity", True), "at_rest"),
    ],
)
def test_what_is_no_record_is_refused(given, names):
    with pytest.raises(ValueError, match=names):
        mpm.Record(*given)
