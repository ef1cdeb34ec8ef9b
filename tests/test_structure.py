# SPDX-License-Identifier: MIT
"""The package has neither hidden state nor cycles: objects are complete, and only the state is replaced."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import house

import mpm_dolfinx

ROOT = Path(mpm_dolfinx.__file__).parent
TREES = {path: ast.parse(path.read_text()) for path in ROOT.rglob("*.py")}


def assigned(tree):
    """Yield (class, method, attribute) of the attributes that methods set on their object."""
    for cls in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for method in (node for node in cls.body if isinstance(node, ast.FunctionDef)):
            for node in ast.walk(method):
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                    if isinstance(node.value, ast.Name) and node.value.id == "self":
                        yield cls.name, method.name, node.attr


def module(path):
    return ".".join(["mpm_dolfinx", *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(".__init__")


def arrows():
    """Return the modules that each module imports."""
    names = {module(path) for path in TREES}
    out = {name: set() for name in names}
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("mpm_dolfinx"):
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & names
                out[module(path)] |= inner or {node.module}
    return out


def folder(name):
    return name.split(".")[1]


def test_imports_make_no_circle():
    assert tuple(TopologicalSorter(arrows()).static_order())


def test_folders_import_downwards_only():
    inner = {name: found for name, found in arrows().items() if (ROOT / name.split(".", 1)[-1].split(".")[0]).is_dir()}
    between = {folder(name): set() for name in inner}
    for name, found in inner.items():
        between[folder(name)] |= {folder(other) for other in found} - {folder(name)}
    assert len(between) > 15 and tuple(TopologicalSorter(between).static_order())


def test_no_folder_has_more_than_fourteen_files():
    folders = {path.parent for path in TREES}
    assert {path.name: n for path in folders if (n := len(list(path.glob("*.py")))) > 14} == {}


CHANGES = {
    ("Simulation", "state"): "the one state",
    ("Simulation", "_state"): "the same, on the present grid",
    ("Grid", "_cells"): "the mesh, made at its first use",
    ("Grid", "_spacing"): "the lines of a grid that follows, set from the state before they are read",
    ("Cells", "at"): "the positions of nodes and cells between these lines",
    ("CompiledForm", "_last"): "the last binding of a form",
    ("Latest", "_key"): "the last key",
    ("Latest", "value"): "the value for this key",
    ("Active", "now"): "the filled cells since the grid reset",
    ("Scene", "_looks"): "the warnings that are still possible",
    ("SideFeeds", "_flows"): "the active set of seepage faces",
    ("SideFeeds", "_nonorthogonal"): "the non-orthogonal flow at the start of the substep",
    ("SideFeeds", "_share"): "the same, as a fraction of the flow in unsaturated soil",
    ("ContactFeeds", "_links"): "the active set of closed contacts",
    ("ContactFeeds", "_correction"): "the non-orthogonal correction of their flow at the start of the substep",
    ("HoldLoads", "data"): "the rows of prescribed sides with their multipliers",
    ("HoldLoads", "_lacked"): "the gaps of sides at the last change of their multipliers",
    ("ContactProblem", "now"): "the pairs and tractions of contacts in a Newton step",
    ("MovedTools", "now"): "the same, and the positions of tools that forces move",
    ("Events", "_before"): "the values of events before the step",
    ("Writer", "_lock"): "the lock of the folder, released at its end",
    ("Writer", "closed"): "whether it is closed",
    ("Table", "columns"): "of a file that begins with its first row",
    ("Checkpoint", "_written"): "the time of the last file",
    ("CutDomains", "_faces"): "the areas of pieces on faces, freed at their only use",
    ("PointData", "_stored"): "the last gradients, freed at the end of a step",
    ("SceneMaterials", "seeded"): "the points as seeded, freed once all bodies are in the state",
}
"""All that objects change after they are made, and why it is no part of the state; what else changes is hidden."""


def test_nothing_else_is_set_outside_of_init():
    late = {(cls, name) for tree in TREES.values() for cls, method, name in assigned(tree) if method != "__init__"}
    assert late <= set(CHANGES)


def test_no_container_stands_for_an_attribute():
    """self.x[0] += 1 and self.x[:] = y change attributes: see `house.hidden`, whose ceiling only decreases."""
    found = [item for item in house.hidden() if "[0]" in item or "[:]" in item or "[()]" in item]
    assert found == []


def test_no_class_has_more_than_twenty_attributes():
    found = {}
    for path, tree in TREES.items():
        for cls, _, name in assigned(tree):
            found.setdefault((path.name, cls), set()).add(name)
    assert {cls: len(names) for cls, names in found.items() if len(names) > 20} == {}


def test_the_step_is_a_page():
    assert len((ROOT / "stepping" / "step.py").read_text().splitlines()) <= 80
    assert len((ROOT / "simulation" / "simulation.py").read_text().splitlines()) <= 360
