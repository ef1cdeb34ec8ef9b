# SPDX-License-Identifier: MIT
"""Names in docstrings and comments exist, at the given place."""

import ast
import importlib
import re
from pathlib import Path
from types import ModuleType

from plateaus import SCENES

import mpm_dolfinx

ROOT = Path(mpm_dolfinx.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
TEXTS = {file: file.read_text() for file in FILES}
TREES = {file: ast.parse(text) for file, text in TEXTS.items()}
NAME = re.compile(r"`([A-Za-z_][\w.]*)`")
WRITTEN = {".txt", ".pvd", ".csv", ".xdmf", ".h5", ".vtu", ".py"}  # files
ELSEWHERE = {"_repr_html_", "write_data", *SCENES}  # names of notebooks, of meshio, and of scenes of plateaus.py
OBJECTS = {"points"}  # which users are given


def module_of(file: Path) -> ModuleType:
    parts = file.relative_to(ROOT.parent).with_suffix("").parts
    return importlib.import_module(".".join(part for part in parts if part != "__init__"))


def words(tree: ast.AST) -> set[str]:
    """Return all names in a file: definitions, parameters, attributes, keywords, and short texts such as keys."""
    out = set()
    for node in ast.walk(tree):
        for kind, name in ((ast.Name, "id"), (ast.Attribute, "attr"), (ast.arg, "arg"), (ast.keyword, "arg")):
            if isinstance(node, kind):
                out.add(getattr(node, name))
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            out.add(node.name)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) < 40:
            out.add(node.value)
    return out


def defined(tree: ast.Module) -> set[str]:
    """Return the functions, classes and values that a module defines."""
    out = {node.name for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    for node in tree.body:
        targets = getattr(node, "targets", None) or filter(None, [getattr(node, "target", None)])
        out |= {name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)}
    return out


WORDS = {file: words(tree) for file, tree in TREES.items()}
EVERY = set().union(*WORDS.values()) | {file.stem for file in FILES} | {file.parent.name for file in FILES} | ELSEWHERE
DEFINED = {file.stem: defined(tree) for file, tree in TREES.items() if file.stem != "__init__"}
MEMBERS = {node.name: words(node) for tree in TREES.values() for node in tree.body if isinstance(node, ast.ClassDef)}


def of_library(name: str, module: ModuleType) -> bool:
    """Return whether a dotted name belongs to a library that a module imports."""
    first, *rest = name.split(".")
    libraries = [value for value in vars(module).values() if isinstance(value, ModuleType)]
    for found in [vars(module).get(first), *(getattr(library, first, None) for library in libraries)]:
        for part in rest:
            found = getattr(found, part, None)
        if found is not None:
            return True
    return False


def stale(file: Path, name: str) -> bool:
    """Return whether a name in a file has no object."""
    if Path(name).suffix in WRITTEN or of_library(name, module_of(file)):
        return False
    *before, last = name.split(".")
    if not before:
        return last not in EVERY
    if name.startswith("mpm_dolfinx."):
        return not (ROOT.parent / name.replace(".", "/")).with_suffix(".py").exists()
    home = before[-1]
    if home in DEFINED:
        return last not in DEFINED[home] and last not in WORDS[file]
    if home in MEMBERS:
        return last not in MEMBERS[home]
    here = home in OBJECTS or home in WORDS[file]
    return not here or last not in EVERY or any(last in names for names in DEFINED.values())


def test_names_in_backticks_are_there():
    """Seven names belonged to renamed or moved objects."""
    found = [(f, name) for f, text in TEXTS.items() for name in NAME.findall(text) if stale(f, name)]
    assert not found, "\n".join(f"{file.relative_to(ROOT)}: {name}" for file, name in found)


def test_a_stale_name_is_found():
    file = ROOT / "stepping" / "scene.py"
    for name in (
        "initial_state.by_body",
        "materials.Skeleton",
        "no_such_name",
        "domains.corner_bits",
        "Simulation.no_such",
    ):
        assert stale(file, name), name
    for name in ("initial_stress.by_body", "Simulation.run", "points.dx", "fem.form", "history.csv"):
        assert not stale(file, name), name
