# SPDX-License-Identifier: MIT
"""The user interface: exported types, one list of conditions, and functions with arguments by parameter names."""

import ast
import inspect
import typing
from pathlib import Path

import meshio
import numpy as np
import pytest
from helpers import without

import mpm_dolfinx as mpm

GRID = mpm.Grid([0, 0], [1.0, 1.2], [4, 5])
BODY = mpm.box(GRID, [0, 0], [1, 1])
SOIL = mpm.Hencky(bulk=1e6, shear=6e5, conductivity=1e-5)
WALLS = {"left": "x", "right": "x", "bottom": "y"}
LONGEST = 12  # of `run` and `Simulation`


def scene(*conditions, **options):
    return mpm.Simulation(GRID, [BODY], [SOIL], walls=WALLS, conditions=conditions, **options)


def named(hint):
    """Return the classes that an annotation names."""
    inner = typing.get_args(hint)
    return [one for part in inner for one in named(part)] if inner else [hint] * isinstance(hint, type)


def public():
    """Yield the public functions, methods and properties of the package, with their names."""
    for name in mpm.__all__:
        value = getattr(mpm, name)
        if inspect.isfunction(value):
            yield name, value
        for key, inner in vars(value).items() if inspect.isclass(value) else ():
            inner = inner.fget if isinstance(inner, property) else inner
            if inspect.isfunction(inner) and not key.startswith("_"):
                yield f"{name}.{key}", inner


def test_types_that_public_functions_return_are_exported():
    seen, missing = vars(mpm) | {"meshio": meshio}, {}  # meshio is imported on use
    for name, function in public():
        hints = typing.get_type_hints(function, localns=seen)
        for kind in named(hints.get("return")):
            if kind.__module__.startswith("mpm_dolfinx") and kind.__name__ not in mpm.__all__:
                missing.setdefault(kind.__name__, []).append(name)
    assert not missing


def test_parameter_lists_are_short():
    lists = {}
    for file in Path(mpm.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                own = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                lists[f"{file.name}: {node.name}"] = len([name for name in own if name != "self"])
    assert {name: count for name, count in lists.items() if count > LONGEST} == {}


def test_conditions_in_any_order_are_one_scene():
    given = [mpm.Traction("top", (0, -1e4)), mpm.Drained("top"), mpm.Pressure("top", 1e3), mpm.RigidPlate("top", 1e3)]
    one, other = (scene(*order, fluid=mpm.Fluid()) for order in (given, given[::-1]))
    assert one.conditions == tuple(given) and other.conditions == tuple(given[::-1])
    for s in (one, other):
        s.step(1.0)
    assert np.array_equal(one.points.corners, other.points.corners)


def test_stage_replaces_conditions_and_keeps_results_of_those_that_stay():
    held, load = mpm.Displacement("top", lambda t: (0, -0.01 * t), "y"), mpm.Traction("top", (1e3, 0))
    s = scene(held)
    s.step(1.0)
    before = s.reactions["displacement_top"]
    s.stage(conditions=[*s.conditions, load])
    assert s.conditions == (held, load) and np.array_equal(s.reactions["displacement_top"], before)
    s.stage()
    assert s.conditions == (held, load)
    s.stage(conditions=without(s, mpm.Traction))
    assert s.conditions == (held,)
    s.stage(conditions=[load])
    assert len(s.reactions) == 0


def test_contacts_stay_those_of_the_scene():
    grid = mpm.Grid([0, 0], [1, 2], [2, 4])
    bodies, contact = [mpm.box(grid, [0, 0], [1, 0.5]), mpm.box(grid, [0, 0.5], [1, 1])], mpm.Contact(1, 0)
    s = mpm.Simulation(grid, bodies, [SOIL], walls=WALLS, conditions=[contact])
    s.stage(conditions=[mpm.Traction("top", (0, -1e3), region=((0, 0.9), (1, 2)))])
    assert contact in s.conditions
    s.stage(conditions=[mpm.Contact(1, 0)])
    assert s.conditions == (contact,)
    with pytest.raises(ValueError, match="must be the contacts of the scene"):
        s.stage(conditions=[mpm.Contact(1, 0, friction=0.3)])


def test_given_displacement_may_be_a_function_of_time_alone():
    places = np.zeros((3, 2))
    for move in (lambda t: (0, -0.1 * t), lambda s: (0, -0.1 * s), lambda X, t: np.full_like(X, -0.1 * t) * (0, 1)):
        assert mpm.Displacement("top", move).at(2.0, places).tolist() == [[0, -0.2]] * 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scene(fluid=mpm.Fluid(), pressure=lambda X: X[:, 0]), r"pressure: .*\(X\), must be a function of x"),
        (lambda: scene(initial_stress=lambda y: -np.ones((len(y), 3))), r"\(y\), must be a function of x"),
        (lambda: mpm.Hencky(bulk=lambda x: 1e6 + x[:, 0], shear=1e6).at(np.zeros((2, 2))), r"must be a function of X"),
        (lambda: scene(gravity=lambda x: (0, -9.81)), "gravity: .* must be"),
    ],
    ids=["pressure", "initial stress", "constant of a material", "gravity"],
)
def test_functions_of_other_places_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_numerical_options_are_checked_when_they_are_made():
    for wrong in ({"method": "euler"}, {"quadrature": "gauss"}, {"coupling": "none"}, {"tolerance": 0.0}):
        with pytest.raises(ValueError, match=r"must be|in \(0, 1\)"):
            mpm.Numerics(**wrong)
    assert scene(numerics=mpm.Numerics(tolerance=1e-6)).scene.numerics.tolerance == 1e-6
