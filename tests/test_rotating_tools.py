# SPDX-License-Identifier: MIT
"""Free tools rotate: they spin in flight, roll or slip down an incline, and tip over."""

import numpy as np
import pytest
from meshes import box_mesh
from scipy.integrate import solve_ivp

import mpm_dolfinx as mpm
from mpm_dolfinx.contact.shapes import uniform

G = 9.81
ROCK = mpm.Hencky(bulk=1e7, shear=6e6, grain_density=2000.0)
RIM = {"bottom": "xy", "left": "x", "right": "x"}


def of_tool(s, quantity):
    return s.outcome(quantity).array[0]


def balance(e):
    """Return the error of the energy balance, divided by the largest energy."""
    total = sum(e[name] for name in ("kinetic", "elastic", "dissipated", "viscous", "friction")) - e["external"]
    return np.abs(total - total[0]).max() / max(np.abs(values).max() for values in e.values())


@pytest.mark.parametrize(
    ("shape", "centroid", "gyration"),
    [
        (mpm.Ball((2.0, 3.0), 0.4), (2.0, 3.0), 0.4**2 / 2),
        (mpm.Convex([(1, 2), (4, 2), (4, 4), (1, 4)]), (2.5, 3.0), (3**2 + 2**2) / 12),
        (mpm.Convex([(1e4, 0), (1e4 + 3, 0), (1e4, 6)]), (1e4 + 1, 2.0), (3**2 + 6**2) / 18),
    ],
)
def test_a_disc_and_polygons_have_the_moments_of_uniform_solids(shape, centroid, gyration):
    of = uniform(shape)
    assert of.centroid == pytest.approx(centroid)
    assert mpm.Tool(shape, mass=3.0).inertia(2) == pytest.approx(3 * gyration, rel=1e-7)


def test_a_tool_spins_as_it_flies():
    grid = mpm.Grid([0, 0], [1, 1], [4, 4])
    box = mpm.Convex([(0, 5), (0.4, 5), (0.4, 5.2), (0, 5.2)])
    tools = [
        mpm.Tool(box, mass=3, velocity=(0.5, 1.0), spin=-2.0, rotation_rad=0.3),
        mpm.Tool(box, mass=3, direction=(0, 1)),
    ]
    options = {"walls": {"bottom": "y", "left": "x", "right": "x"}, "gravity": (0, -G), "inertia": True}
    s = mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.3])], [ROCK], conditions=tools, **options)
    e = s.run(0.5, 0.1, energies=True, progress=False).energies
    assert of_tool(s, "tool_travel") == pytest.approx([0.25, 0.5 - G / 8])
    assert of_tool(s, "tool_rotation") == pytest.approx(-1.0) and of_tool(s, "tool_spin") == -2.0
    assert len(s.outcome("tool_spin").array) == 1 and balance(e) < 5e-3
    assert e["kinetic"][0] == pytest.approx(3 * (0.5**2 + 1) / 2 + 3 * (0.4**2 + 0.2**2) / 12 * 2**2 / 2)


def incline(friction, aslant, h=0.05, radius=0.2):
    """Return a rigid disc on a layer inclined by 30 degrees to gravity, along the grid or not, and axes."""
    turn = -np.pi / 6 if aslant else 0.0
    e = np.array([np.cos(turn), np.sin(turn)])
    normal = np.array([-e[1], e[0]])
    if aslant:
        grid = mpm.Grid([0, 0], [1.6, 1.4], [round(1.6 / h), round(1.4 / h)])
        at = np.array([0.15, 0.93])
        base = at - 0.2 * normal
        mesh = box_mesh("quad", [104, 16], [0, 0], [1.3, 0.2], place=lambda X: base + X[:, :1] * e + X[:, 1:] * normal)
        layer, holds, walls = mpm.from_mesh(grid, mesh), [mpm.Displacement("bottom", (0, 0))], {}
    else:
        grid, at = mpm.Grid([0, 0], [1.4, 0.7], [round(1.4 / h), round(0.7 / h)]), np.array([0, 0.2 + 0.37 * h])
        layer, holds, walls = mpm.box(grid, [0, 0], [1.4, at[1]], per_cell=4), [], RIM
    disc = mpm.Tool(mpm.Ball(at + 0.25 * e + radius * normal, radius), mass=100.0, friction=friction)
    gravity = G * (0.5 * e - np.sqrt(0.75) * normal)
    options = {"walls": walls, "conditions": [disc, *holds], "gravity": gravity, "inertia": True}
    return mpm.Simulation(grid, [layer], [ROCK], **options), e


@pytest.mark.slow
@pytest.mark.parametrize("aslant", [False, True])
@pytest.mark.parametrize("friction", [0.3, 0.1])
def test_a_rigid_disc_rolls_down_a_layer_or_slips(friction, aslant):
    """Exact: the acceleration is 2/3 g sin b if mu >= tan b / 3; otherwise the spin grows by 2 mu g cos b / R."""
    s, e = incline(friction, aslant)
    t, slips = 0.4, friction < np.tan(np.pi / 6) / 3
    energies = s.run(t, 0.01, energies=True, progress=False).energies
    a = G * (0.5 - friction * np.sqrt(0.75)) if slips else G / 3
    spin = -2 * friction * G * np.sqrt(0.75) / 0.2 if slips else -a / 0.2
    assert of_tool(s, "tool_travel") @ e == pytest.approx(a * t**2 / 2, rel=0.01)
    assert of_tool(s, "tool_velocity") @ e == pytest.approx(a * t, rel=0.01)
    assert of_tool(s, "tool_rotation") == pytest.approx(spin * t**2 / 2, rel=0.01)
    assert of_tool(s, "tool_spin") == pytest.approx(spin * t, rel=0.01)
    assert balance(energies) < 0.01


def tipping(mirror=1, **options):
    """Return a rough rigid box that tips over on a corner of radius 0.15 m, with its angle and spin after t (s)."""
    h, width, r, m, lean, spin = 0.05, 0.6, 0.15, 100.0, 0.3, 1.0
    grid = mpm.Grid([0, 0], [1.2, 0.4], [24, 8])
    top, arm = 0.2 + 0.37 * h, np.sqrt(2) * (width / 2 - r)
    c = np.array([0.6 + mirror * (arm * np.sin(lean) - 0.2), top + r + arm * np.cos(lean)])

    def rounded(y):
        off = np.abs(y - c) - width / 2 + r
        return np.linalg.norm(np.maximum(off, 0), axis=1) + np.minimum(off.max(axis=1), 0) - r

    moment = m * width**2 / 6
    motion = {"velocity": spin * np.array([mirror * (r + arm * np.cos(lean)), -arm * np.sin(lean)])}
    motion |= {"spin": -mirror * spin, "rotation_rad": mirror * (np.pi / 4 - lean)}
    box = mpm.Tool(rounded, centre=c, mass=m, moment=moment, friction=1.0, **motion)
    options = {"walls": RIM, "gravity": (0, -G), "inertia": True, **options}
    layer = mpm.box(grid, [0, 0], [1.2, top], per_cell=4)
    s = mpm.Simulation(grid, [layer], [ROCK], conditions=[box], **options)

    def slope(t, y):
        inertia = moment + m * (r * r + arm * arm + 2 * r * arm * np.cos(y[0]))
        return [y[1], m * arm * np.sin(y[0]) * (G + r * y[1] ** 2) / inertia]

    return s, lambda t: solve_ivp(slope, (0, t), [lean, spin], rtol=1e-10).y[:, -1] - [lean, 0]


def test_a_box_tips_over_as_a_rigid_one_on_either_side_alike(tmp_path):
    """Exact, without slip: the corner rolls, and the energy is constant."""
    (s, exact), (other, _), (again, _) = tipping(), tipping(-1), tipping(-1)
    e = s.run(0.24, 0.02, energies=True, progress=False).energies
    rotation, spin = exact(0.24)
    assert of_tool(s, "tool_rotation") == pytest.approx(-rotation, rel=0.01)
    assert of_tool(s, "tool_spin") == pytest.approx(-spin, rel=0.01)
    assert balance(e) < 0.01
    half = other.run(0.04, 0.02, checkpoint=mpm.Checkpoint(tmp_path / "tips.npz"), progress=False)
    assert half.outcome("tool_rotation")["tool"][-1] > 0
    resumed = mpm.resume(again, tmp_path / "tips.npz")
    for one, after in ((other, half), (again, resumed)):
        one.run(0.06, 0.02, after=after, progress=False)
    for quantity in ("tool_travel", "tool_rotation", "tool_spin"):
        assert np.array_equal(of_tool(again, quantity), of_tool(other, quantity))
    (s, _) = tipping()
    s.run(0.06, 0.02, progress=False)
    assert of_tool(other, "tool_rotation") == pytest.approx(-of_tool(s, "tool_rotation"), rel=1e-8)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"spin": 1.0}, "spin = 1.0, must be given with a mass"),
        ({"moment": 1.0}, "moment = 1.0, must be given with a mass"),
        ({"mass": 1.0, "moment": 0.0}, "moment = 0.*must be > 0"),
        ({"mass": 1.0, "spin": np.nan}, "spin = nan"),
        ({"mass": 1.0, "spin": 1.0, "direction": (0, 1)}, "spin = 1, must be 0 for a tool that does not rotate"),
        ({"mass": 1.0, "centre": (0.6, 1.5)}, r"centre = \(0.6, 1.5\), must be the centroid"),
        (
            {"mass": 1.0, "moment": 1.0, "shape": mpm.HalfSpace((0, 1), (0, -1))},
            "both must be given for this shape",
        ),
    ],
)
def test_rotations_that_cannot_be_are_refused(options, said):
    with pytest.raises(ValueError, match=said):
        mpm.Tool(**{"shape": mpm.Ball((0.5, 1.5), 0.2), **options}).check(2)


def test_rotations_in_space_and_about_the_axis_are_refused():
    with pytest.raises(ValueError, match="in 3D tools do not rotate"):
        mpm.Tool(mpm.Ball((0, 0, 0), 1.0), mass=1.0, moment=1.0).check(3)
    grid = mpm.Grid([0, 0], [1, 1], [4, 4], axisymmetric=True)
    tool = mpm.Tool(mpm.Ball((0, 0.8), 0.2), mass=1.0, spin=1.0)
    with pytest.raises(ValueError, match="must be left out in axisymmetry"):
        mpm.Simulation(grid, [mpm.box(grid, [0, 0], [1, 0.3])], [ROCK], conditions=[tool], walls=RIM, inertia=True)


@pytest.mark.slow
def test_the_torque_of_a_rough_disc_in_clay_is_steady():
    """The torque is 2 pi r^2 s_u. The poles of the disc are in the middle of cells, and clay slips along the disc."""
    strength, cells = 1e3, 5
    h = 1 / cells
    grid = mpm.Grid([-2, -2], [2, 2 + 4 * h], [4 * cells, 4 * cells + 4])
    angle = np.linspace(0, 2 * np.pi, 16 * cells, endpoint=False)
    centre = np.array([0.5 * h, 0.5 * h])
    hole = centre + np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners, names = [[-2, -2], [2, -2], [2, 2 + 0.5 * h], [-2, 2 + 0.5 * h]], ["bottom", "right", "top", "left"]
    clay = mpm.polygon(grid, corners, names, holes={"hole": hole}, size=h / 2)
    soil = mpm.DruckerPrager(bulk=5e6, shear=1e5, friction=0.0, dilation=0.0, cohesion=strength)
    turn = {"rotation_rad": lambda t: max(0.0, t - 1), "centre": centre, "adhesion": strength}
    disc = mpm.Tool(mpm.Ball(centre, 1.0), **turn, name="disc")
    confined = mpm.Pressure("top", lambda t: 5 * strength * min(1, t))
    walls = {"left": "xy", "right": "xy", "bottom": "xy"}
    numerics = mpm.Numerics(renewal=True)
    s = mpm.Simulation(grid, [clay], [soil], walls=walls, conditions=[confined, disc], numerics=numerics)
    torques = []
    s.run(1.0, 1.0, progress=False)
    s.run(1 + 2 * np.pi, h / 2, observe=[lambda s: torques.append(s.tool_forces["disc"][-1])], progress=False)
    means = [part.mean() for part in np.array_split(torques[len(torques) // 10 :], 5)]
    assert means == pytest.approx(np.full(5, 2 * np.pi * strength), rel=0.03)
    assert np.ptp(means) < 0.003 * means[0]
