# SPDX-License-Identifier: MIT
"""User-defined conditions outside of the package: objects with the methods of loads or fluid conditions."""

from dataclasses import dataclass

import numpy as np
import pytest
import ufl
from helpers import SOFT, refused_in_one_line

import mpm_dolfinx as mpm
from mpm_dolfinx.forms.point_forms import FormPoints, PointForm

STIFFNESS = 2e6  # Pa/m


class Forms:
    """Work of springs, k (u + w) . v, with the displacement w at the start of the step, and its derivative."""

    def __init__(self, grid, u):
        self.points = p = FormPoints(grid, before=(grid.dim,))
        v, du = ufl.TestFunction(u.function_space), ufl.TrialFunction(u.function_space)
        self.force = PointForm(-STIFFNESS * ufl.inner(p.value(u) + p.before, p.value(v)) * p.dx, p)
        self.slope = PointForm(STIFFNESS * ufl.inner(p.value(du), p.value(v)) * p.dx, p)


@dataclass
class Springs:
    """Springs on a side of the bodies."""

    side: str
    name: str = "springs"
    region = None

    def acting(self, setting):
        return SpringsOfStage(self, setting)


class SpringsOfStage(mpm.Acting):
    def __init__(self, springs, setting):
        self.springs, self.setting, self.faces = springs, setting, setting.sides.of(springs)
        self.surfaces = [self.faces]

    def placed(self, place):
        p, grid, forms = place.cut.surface(self.faces), self.setting.grid, self.setting.forms(Forms)
        moved = p.now(place.points) - p.origin(place.points)
        fields = {"size": np.linalg.norm(p.area(place.points), axis=1), "before": moved}
        cell, x, fields = grid.gathered([(p.cell, p.x, fields)])
        return SpringLoads(self, forms, forms.points.at(cell, x, fields["size"], before=fields["before"]))


class SpringLoads(mpm.Loads):
    holding = True

    def __init__(self, of, forms, data):
        self.of, self.forms, self.data = of, forms, data

    def loads(self, b):
        self.forms.force.assemble_vector(b, self.data)

    def tangent(self, K):
        self.forms.slope.assemble_matrix(K, self.data)

    def outcome(self, at):
        u = at.nodal[self.data.points.grid.cell_nodes[self.data.cells]]
        shape = self.data.points.grid.shape_values(self.data.cells, self.data.x)
        stretch = self.data["before"] + np.einsum("mk,mkd->md", shape, u)
        force = -STIFFNESS * (self.data.volume[:, None] * stretch).sum(axis=0)
        return {"spring_forces": {self.of.springs.name: self.of.setting.grid.comm.allreduce(force)}}


def block(**options):
    """Return a block with a load on top, on springs alone, between smooth walls."""
    grid = mpm.Grid([0, -0.2], [1.0, 1.0], [5, 6])
    load = mpm.Traction("top", lambda t: (0, -2e4 * min(t, 1)), name="load")
    walls = {"left": "x", "right": "x"}
    body = mpm.box(grid, [0, 0], [1, 0.77])
    conditions = [load, *options.pop("conditions", [])]
    return mpm.Simulation(grid, [body], [SOFT], walls=walls, conditions=conditions, **options)


def test_a_condition_of_the_users_own_acts_as_a_term_on_the_same_side():
    def term(points, u, v):
        return STIFFNESS * ufl.inner(points.value(u) + points.displacement, points.value(v)) * points.dx

    own, other = block(conditions=[Springs("bottom")]), block(terms=[mpm.OnSide("bottom", term)])
    for s in (own, other):
        s.run(1.0, 0.25, progress=False)
    assert own.points.x == pytest.approx(other.points.x, abs=1e-12)
    assert own.outcome("spring_forces")["springs"] == pytest.approx([0, 2e4], abs=1e-3)
    assert own.result.outcome("spring_forces")["springs"][1:, 1] == pytest.approx(
        2e4 * np.array([0.25, 0.5, 0.75, 1.0])
    )


@dataclass
class Skin:
    """A skin on a side that resists the flow, q = conductance p: a Robin condition."""

    side: str
    conductance: float  # m/(Pa s)
    name: str = "skin"
    region = None

    def feeding(self, setting):
        return SkinOfStage(self, setting)


class SkinOfStage(mpm.Feeding):
    def __init__(self, skin, setting):
        self.skin, self.grid, self.faces = skin, setting.grid, setting.sides.of(skin)
        self.surfaces, self.count = [self.faces], 1

    def placed(self, wet):
        p = wet.cut.surface(self.faces)
        cell, x, fields = self.grid.gathered([(p.cell, p.x, {"area": p.area(wet.points)})])
        reach = x - self.grid.midpoints[cell] - wet.contents.centroid[cell]
        return SkinFeeds(self, wet.contents.slot(cell), fields["area"], reach)

    def fed(self, cut, pieces):
        return cut.surface(self.faces).at

    def unknown(self, value):
        return {"outflows": {self.skin.name: np.array(value)}}


class SkinFeeds(mpm.Feeds):
    def __init__(self, of, cells, area, reach):
        self.of, self.cells, self.area, self.reach = of, cells, area, reach

    def conducting(self, flow):
        size = np.linalg.norm(self.area, axis=1)
        normal = self.area / size[:, None]
        distance = np.einsum("md,md->m", self.reach, normal)
        return size / (distance / flow.across(self.cells, normal) + 1 / self.of.skin.conductance)

    def leaving(self, at, fluid):
        out = np.bincount(self.cells, at, len(fluid.p)) * fluid.pi
        return mpm.Leaving(out, np.abs(out))

    def slope(self, at, fluid):
        return np.bincount(self.cells, at, len(fluid.p))

    def outcome(self, at, fluid):
        out = self.of.grid.comm.allreduce(at @ fluid.pi[self.cells])
        return {"outflows": {self.of.skin.name: np.array(out)}}


@pytest.mark.parametrize("conductance", [1e-9, 1e-6])
def test_a_skin_of_the_users_own_on_a_side_resists_the_flow_through_it(conductance):
    """Body and skin are in series: the flow is p A / (L / kappa + 1 / conductance)."""
    ends = [mpm.Drained("bottom", 1e4), Skin("top", conductance)]
    s = block(conditions=[mpm.Displacement("bottom", (0, 0)), *ends], fluid=mpm.Fluid())
    s.run(1e4, 1e3, progress=False)
    height = s.points.corners[:, :, 1].max() - s.points.corners[:, :, 1].min()
    mobility = SOFT.conductivity / s.scene.fluid.unit_weight
    through = 1e4 / (height / mobility + 1 / conductance)
    assert s.outflows["skin"] == pytest.approx(through, rel=1e-4)
    assert s.outflows["skin"] == pytest.approx(-s.outflows["drained_bottom"], rel=1e-6)


def test_a_block_without_its_springs_is_free_to_move(tmp_path):
    refused_in_one_line(lambda: block().step(0.25), "walls", "1 of 3 modes", tmp_path, 400)


def test_results_are_found_by_names_and_not_by_positions():
    s = block(conditions=[Springs("bottom"), mpm.Displacement("left", (0, 0), "y", name="clamp")])
    s.step(0.5)
    assert s.reactions["clamp"][1] > 0
    with pytest.raises(KeyError, match=r"0: must be one of 'clamp'"):
        s.reactions[0]


@pytest.mark.parametrize(
    "names, value",
    [(("foot", "foot"), "of another condition, must be unique"), (("a/b", None), "'a/b'"), ((3, None), "name = 3")],
)
def test_a_name_that_is_none_or_of_two_conditions_is_refused(names, value, tmp_path):
    held = [mpm.Displacement(side, (0, 0), "y", name=name) for side, name in zip(("left", "right"), names, strict=True)]
    refused_in_one_line(lambda: block(conditions=held), "name", value, tmp_path, 400)


def test_conditions_without_names_have_those_of_kind_and_side():
    held = [mpm.Displacement("left", (0, 0), "y", region=([0, low], [1, low + 0.3])) for low in (0, 0.4)]
    drained = [mpm.Drained("top"), mpm.Drained("bottom", name="drain")]
    s = block(conditions=[*held, *drained], fluid=mpm.Fluid())
    assert list(s.reactions) == ["displacement_left", "displacement_left_2"]
    assert list(s.outflows) == ["drained_top", "drain"]


def test_a_tool_of_a_later_stage_keeps_what_one_of_the_same_given_name_has_on_points():
    def plate(**options):
        return mpm.Tool(mpm.HalfSpace((0, 0.77), (0, -1)), displacement=lambda t: (0, -0.02 * min(t, 1)), **options)

    for name, kept in (("plate", True), (None, False)):
        s = block(conditions=[Springs("bottom"), plate(name=name)])
        s.run(1.0, 0.5, progress=False)
        data = "plate_pressure" if kept else "tool_pressure"
        before = s.points.data[data].copy()
        s.stage(conditions=[*s.conditions[:2], plate(name=name, friction=0.1)])
        assert before.max() > 1e3 and np.array_equal(s.points.data[data], before) == kept
