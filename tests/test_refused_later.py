# SPDX-License-Identifier: MIT
"""Invalid fields of a stage, numbers in forms, checkpoints and observers are refused where they are passed."""

import numpy as np
import pytest
import ufl

import mpm_dolfinx as mpm

GRID = mpm.Grid([0, 0], [1.0, 1.0], [6, 6])
BODY = mpm.box(GRID, [0, 0], [1, 0.5])
WALLS = {"left": "x", "right": "x", "bottom": "xy"}


def of_place(value):
    return lambda X: np.full(len(X), value)


def scene(material=None, wet=False, **options):
    soil = material or mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
    water = {"fluid": mpm.Fluid(), "conditions": [mpm.Drained("top")]} if wet else {}
    return mpm.Simulation(
        GRID,
        [BODY],
        [soil],
        walls=WALLS,
        conditions=[mpm.Traction("top", (0, -1e4)), *options.pop("conditions", []), *water.pop("conditions", [])],
        **water,
        **options,
    )


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("porosity", 2.0, r"porosity = 2\.0, must be in"),
        ("conductivity", -1e-5, r"conductivity = -1e-05, must be >= 0"),
        ("biot", 0.0, r"biot = 0\.0, must be in"),
    ],
)
def test_fields_of_a_stage_are_checked_as_those_of_the_material(name, value, said):
    soil = mpm.Hencky(
        **{"bulk": 1e6, "shear": 6e5, "conductivity": 1e-5, name: of_place(0.5 if name != "conductivity" else 1e-5)}
    )
    s = scene(soil, wet=True)
    before = s.state
    with pytest.raises(ValueError, match=said):
        s.stage(fields={name: value})
    assert s.state is before
    s.stage(fields={name: 0.5 if name != "conductivity" else 2e-5})


@pytest.mark.parametrize(("name", "value"), [("porosity", 0.3), ("biot", 0.8), ("grain_bulk", 3e9)])
def test_a_stage_with_fluid_does_not_change_the_pores(name, value):
    """Earlier, a quarter of the water vanished with the porosity, and the balance of fluid did not tell."""
    soil = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5, **{name: of_place(0.4 if name == "porosity" else 1.0)})
    s = scene(soil, wet=True)
    with pytest.raises(ValueError, match=rf"stage: fields: '{name}' = .*, must remain .* in a scene with fluid"):
        s.stage(fields={name: value})
    scene(soil).stage(fields={name: value})  # in dry soil there is no water


def test_fields_of_a_stage_are_checked_beside_each_other():
    sand = mpm.MohrCoulomb(bulk=1e7, shear=5e6, friction=of_place(30.0), dilation=20.0, cohesion=1e3)
    with pytest.raises(ValueError, match=r"MohrCoulomb: .*must be"):
        scene(sand).stage(fields={"friction": 10.0})
    with pytest.raises(ValueError, match=r"stage: fields.*must be"):
        scene(sand).stage(fields=["friction"])
    s = scene(sand)
    with pytest.warns(mpm.ConditionWarning, match="is 'friction' meant"):
        s.stage(fields={"fricton": np.full(len(s.points), 10.0)})
    with pytest.raises(ValueError, match=r"must be one of .*friction.*, or new data"):
        s.stage(fields={"cohesoin": 1e3})


def stiffened(F, bulk, shear):
    return np.inf * ufl.tr(F)


@pytest.mark.parametrize(
    "make",
    [
        lambda: scene(terms=[lambda points, u: float("nan") * ufl.inner(points.value(u), points.value(u)) * points.dx]),
        lambda: scene(wet=True, terms=[mpm.Source(lambda points, q: float("inf") * q * points.dx)]),
        lambda: scene(type("Law", (mpm.Skeleton,), {"energy": staticmethod(stiffened)})(1e6, 1e6)),
    ],
    ids=["term", "source", "law"],
)
def test_numbers_in_forms_are_finite(make):
    with pytest.raises(ValueError, match=r"contains (nan|inf), must be finite"):
        make()


def test_a_source_depends_on_its_test_function():
    with pytest.raises(ValueError, match=r"sources: .* does not depend on q, must be linear in q"):
        scene(wet=True, terms=[mpm.Source(lambda points, q: 1e-6 * points.dx)])


@pytest.mark.parametrize("other", [0, 1, 2])
def test_a_checkpoint_with_other_tools_is_one_of_another_scene(other, tmp_path):
    plate = mpm.HalfSpace((0, 0.5), (0, -1))
    tools = [[], [mpm.Tool(plate)], [mpm.Tool(plate, friction=0.3)]]
    scene(conditions=[*tools[other - 1]]).run(0.5, 0.25, checkpoint=mpm.Checkpoint(tmp_path / "c"))
    with pytest.raises(ValueError, match="checkpoint of another scene: data that points keep of conditions"):
        mpm.resume(scene(conditions=[*tools[other]]), tmp_path / "c")


def test_an_observer_takes_the_simulation():
    with pytest.raises(ValueError, match=r"observe: .*must be a function of the simulation"):
        scene().run(1.0, 0.5, observe=lambda: None)


def test_stresses_at_rest_need_a_weight_or_a_surcharge():
    with pytest.raises(ValueError, match="K0 has neither gravity at the start nor surcharge"):
        scene(gravity=lambda t: (0, -9.81 * t), initial_stress=mpm.K0(0.5))
    scene(gravity=lambda t: (0, -9.81 * t), initial_stress=mpm.K0(0.5, surcharge=1e4))
