# SPDX-License-Identifier: MIT
"""A fill is placed on the present surface of its seeded neighbours, without gap or overlap, at rest."""

import numpy as np
import pytest
from helpers import without

import mpm_dolfinx as mpm
from mpm_dolfinx.points.cutting import corner_bits, volumes

SOFT = mpm.Hencky(bulk=5e5, shear=3e5, porosity=0.5, conductivity=1e-6)
DAY = 86400.0


def face(s, body, end):
    """Return the present corners (k, d) of the upper or lower side of a body, ordered by position."""
    d = s.grid.dim
    start = sum(len(b) for b in s.bodies[:body])
    rows = np.flatnonzero(s.bodies[body].sides[:, -1, end])
    corners = s.points.corners[np.searchsorted(s.points.id, start + rows)]
    x = corners[:, corner_bits(d)[:, -1] == end].reshape(-1, d)
    return np.unique(np.round(x, 12), axis=0)


def gap(s, below, above):
    """Return the largest distance between the sides of two bodies in plane strain, in m."""
    lower, upper = face(s, below, 1), face(s, above, 0)
    x = np.linspace(upper[0, 0], upper[-1, 0], 5001)
    return np.abs(np.interp(x, *upper.T) - np.interp(x, *lower.T)).max()


def embankment(slope, lifts=6):
    """Return soft ground under six lifts of 1 m with slopes 1 : slope and a crest 24 m wide."""
    crest, length = 24.0, 60.0
    base = crest + 2 * lifts * slope
    n = round(base)
    grid = mpm.Grid([0, 0], [length, 16.0], [60, 16])

    def lift(k):
        def taper(x):
            return np.stack(
                [length / 2 + (x[:, 0] - length / 2) * (base - 2 * slope * (x[:, 1] - 6)) / n, x[:, 1]], axis=1
            )

        return mpm.mapped(grid, mpm.box(grid, [(length - n) / 2, 6 + k], [(length + n) / 2, 7 + k]), taper)

    bodies = [mpm.box(grid, [0, 0], [length, 6]), *[mpm.Later(lift(k)) for k in range(lifts)]]
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    options = {"gravity": (0, -9.81), "fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]}
    return mpm.Simulation(grid, bodies, [SOFT], walls=walls, **options), length - base


@pytest.mark.parametrize("slope", [1.0, 1.25, 2.0])
def test_an_embankment_in_lifts_has_its_crest_and_the_ground_beside_it_free_and_no_gaps(slope):
    s, beside = embankment(slope)
    s.run(30 * DAY, 30 * DAY, progress=False)
    for k in range(1, 7):
        s.stage(add=[k], conditions=[*without(s, mpm.Traction), mpm.Traction("top", (0, -1.0))])
        (top,) = s.state.stage.acting[-1].surfaces
        assert top.area0.sum() == pytest.approx(beside + 24 + 2 * slope * (6 - k), rel=1e-12)
        assert k == 1 or gap(s, k - 1, k) < 1e-11, "lifts have as many domains side by side"
        assert gap(s, k - 1, k) < 1e-3, "two straight edges on one of the ground's differ by its bend"
        assert face(s, k, 1)[:, 1] == pytest.approx(6.0 + k), "the new crest is level"
        assert (volumes(s.points.corners) > 0).all()
        result = s.run(s.t + 30 * DAY, 15 * DAY, progress=False)
        free, between = top.area0.sum(), gap(s, k - 1, k)
        print(f"lift {k}: free {free:.9f} m, gap {between:.0e} m, fluid balance {result.balance:.0e}")
        assert result.converged and result.balance < 1e-8
        assert k == 1 or gap(s, k - 1, k) < 1e-8
    assert face(s, 0, 1)[:, 1].min() < 5.6, "the ground has settled by half a metre"


def settled(dim=2, per_cell=2, quadrature="domain", until=1.0, **options):
    """Return ground that settles more on its left than on its right, and a fill, 1 m high, that is added later."""
    grid = mpm.Grid([0] * dim, [4.0] * dim, [8] * dim)
    ground = mpm.box(grid, [0] * dim, [*[4] * (dim - 1), 2])
    fill = mpm.box(grid, [1] * (dim - 1) + [2], [3] * (dim - 1) + [3], per_cell=per_cell)
    half = mpm.Traction("top", [0] * (dim - 1) + [-8e4], region=([0] * dim, [2, *[4] * (dim - 1)]))
    walls = {name: "xyz"[:dim] for name in ("left", "right", "bottom", *["front", "back"][: 2 * dim - 4])}
    options = {"conditions": [half], "numerics": mpm.Numerics(quadrature=quadrature)} | options
    s = mpm.Simulation(grid, [ground, mpm.Later(fill)], [SOFT], walls=walls, gravity=[0.0] * dim, **options)
    if until:
        s.run(until, 0.5, progress=False)
    return s


@pytest.mark.parametrize(("dim", "per_cell"), [(2, 2), (2, 4), (2, 1), (3, 2)])
def test_a_fill_follows_the_surface_and_its_domains_are_at_rest_as_they_are(dim, per_cell):
    s = settled(dim, per_cell)
    s.stage(add=[1], conditions=[], gravity=[0.0] * (dim - 1) + [-9.81])
    new = s.points.of(np.arange(len(s.bodies[0])), kept=False)
    below, above = face(s, 0, 1), face(s, 1, 0)
    near = np.linalg.norm(above[:, None] - below, axis=2).min(axis=1)
    on = near if per_cell <= 2 else near[::2]
    assert on.max() < 1e-11 and face(s, 1, 1)[:, -1] == pytest.approx(3.0) and np.ptp(above[:, -1]) > 0.05
    assert new.volume0 == pytest.approx(volumes(new.corners), rel=1e-12) and (new.J == 1).all()
    assert (new.origin == new.corners).all()
    assert s.run(2.0, 1.0, progress=False).converged
    assert (
        np.linalg.norm(face(s, 1, 0)[:, None] - face(s, 0, 1), axis=2).min(axis=1)[:: max(1, per_cell // 2)].max()
        < 1e-8
    )


def test_a_fill_on_ground_that_has_not_moved_is_as_it_was_seeded():
    s = settled(conditions=[])
    seeded = s.scene.materials.seeded.corners
    s.stage(add=[1])
    assert np.abs(s.points.corners[-64:] - seeded[-64:]).max() < 1e-14 and len(s.points) == len(seeded)


def test_a_fill_between_walls_of_a_pit_follows_all_of_them():
    grid = mpm.Grid([0, 0], [4.0, 4.0], [8, 8])
    parts = [([0, 0], [4, 1]), ([0, 1], [1, 2]), ([3, 1], [4, 2]), ([1, 1], [3, 2])]
    bodies = [mpm.box(grid, *part) for part in parts]
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [*bodies[:3], mpm.Later(bodies[3])], [SOFT], walls=walls, gravity=(0, -3 * 9.81))
    s.run(1.0, 0.5, progress=False)
    s.stage(add=[3])
    pit = np.concatenate([s.points.corners[s.points.id < len(s.points) - len(bodies[3])].reshape(-1, 2)])
    fill = s.points.of(np.arange(sum(map(len, bodies[:3]))), kept=False)
    X = bodies[3].corners().reshape(-1, 2)
    against = (X[:, 1] == 1) | (X[:, 0] == 1) | (X[:, 0] == 3)
    off = np.linalg.norm(fill.corners.reshape(-1, 2)[against][:, None] - pit, axis=2).min(axis=1)
    assert off.max() < 1e-12 and (volumes(fill.corners) > 0).all()
    assert s.run(2.0, 1.0, progress=False).converged


def test_what_has_risen_into_a_fill_makes_it_thinner_or_is_refused_with_how_far():
    def risen(height, bottom=1.0):
        grid = mpm.Grid([0, 0], [2.0, 3.0], [4, 6])
        bodies = [mpm.box(grid, [0, 0], [2, 1]), mpm.Later(mpm.box(grid, [0, bottom], [2, bottom + 0.5]))]
        lift = [mpm.Displacement("top", lambda t, X: (0, height * t))]
        s = mpm.Simulation(grid, bodies, [SOFT], walls={"bottom": "y", "left": "x"}, conditions=lift)
        s.run(1.0, 0.25, progress=False)
        return s

    s = risen(0.3)
    s.stage(add=[1], conditions=[])
    assert s.points.volume0[-16:].sum() == pytest.approx(2 * 0.2, rel=3e-4)  # the lift gives way by 1 / 300 of a strain
    with pytest.raises(ValueError, match=r"body 1: its seeded neighbour has moved by up to 0.45 m; the domain"):
        risen(0.45).stage(add=[1])
    with pytest.raises(
        ValueError, match=r"stage: add: body 1: body 0 has moved into it by 0.2 m at .*; must be seeded in space"
    ):
        risen(0.4, bottom=1.2).stage(add=[1])


def test_a_refused_fill_changes_nothing():
    s = settled()
    s.run(2.0, 1.0, progress=False)
    state = s.state
    with pytest.raises(ValueError, match="no point has this side in the region"):
        s.stage(add=[1], conditions=[mpm.Traction("top", -1.0, ((9, 9), (10, 10)))])
    assert s.state is state
    s.stage(add=[1])
    assert s.present == (True, True)


def test_edges_that_cannot_follow_a_bend_are_named_with_the_distance(warned):
    strip = mpm.Traction("top", (0, -4e5), region=((1.7, 0), (2.3, 2)))
    settled(per_cell=1, conditions=[strip]).stage(add=[1], conditions=[])
    assert "body 1: its straight edges are up to 0.025 m" in warned()[-1]


@pytest.mark.parametrize("quadrature", ["domain", "point"])
def test_a_run_resumed_after_a_fill_came_has_the_same_bits(quadrature, tmp_path):
    one, other = (settled(quadrature=quadrature, until=until) for until in (1.0, 0.0))
    for s in (one, other):
        s.stage(add=[1], conditions=[])
    one.run(2.0, 0.5, progress=False, checkpoint=mpm.Checkpoint(tmp_path / "a.ckpt"))
    one.run(3.0, 0.5, progress=False)
    mpm.resume(other, tmp_path / "a.ckpt")
    other.run(3.0, 0.5, progress=False)
    assert other.t == 3.0 and (one.points.corners == other.points.corners).all()
    assert one.points.volume0.sum() > 8.0 + 2.0 + 0.1


def test_what_a_stage_gave_the_points_must_be_given_anew_when_a_body_comes():
    grid = mpm.Grid([0, 0], [1, 1], [4, 4])
    bodies = [mpm.box(grid, [0, 0], [1, 0.5]), mpm.Later(mpm.box(grid, [0, 0.5], [1, 1]))]
    s = mpm.Simulation(grid, bodies, [SOFT], walls={"bottom": "xy"})
    s.stage(fields={"damage": np.arange(len(s.points))})
    with pytest.raises(
        ValueError, match=r"stage: add: body 1: its points have no 'damage', must be given for all points"
    ):
        s.stage(add=[1])
    s.stage(add=[1], fields={"damage": np.arange(sum(map(len, s.bodies)))})
    assert (s.points.data["damage"] == np.arange(len(s.points))).all()
