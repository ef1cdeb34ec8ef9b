# SPDX-License-Identifier: MIT
"""Measures of the quality of the package's code: `python -m tests.house` prints them.

A number is *structure* if no other value is possible: see `structure` below. A number is *sourced* if a comment on its
line, or the string below it, has one of two forms:

    Source: an equation, a paper (with its year), a definition, a format, or an exact bound, see `SOURCE`;
    Sensitivity (scene "name" of tests/plateaus.py): half this value changes the result by a, and twice this value by b.
    Finer cells change it by c.

The changes are relative. a or b is not zero, so the number affects the scene. Both are below c.
`python tests/plateaus.py` measures these changes again. All other numbers are *ad hoc*.
"""

import ast
import re
import sys
from functools import cache, cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1] / "mpm_dolfinx"
SOURCE = re.compile(
    r"\bSource: .*?(\b(1[89]|20)\d\d\b|\beq\. |\bequation\b|\bdefinition\b|\bformat\b|\bexact\b|\bepsilon\b|\bIEEE\b)",
    re.DOTALL,
)
PLATEAU = re.compile(
    r'\bSensitivity \(scene "(\w+)" of tests/plateaus.py\): half this value changes the result by ([\d.e+-]+), '
    r"and twice this value by ([\d.e+-]*[\d])\. +Finer cells change it by ([\d.e+-]*[\d])"
)
UNITS = {60, 90, 100, 180, 360, 1000, 1e6, 1024, 86400}
"""Per cent, degrees, and the like."""
STYLES = ("figsize", "alpha", "dpi", "bounds")
CONDITIONS = (
    "Traction",
    "Pressure",
    "Displacement",
    "RigidPlate",
    "Drained",
    "Inflow",
    "Rain",
    "OnSide",
    "Tool",
    "Contact",
)


class Module:
    """A file of the package, with its name, its lines and its syntax tree."""

    def __init__(self, path: Path):
        self.path, self.text = path, path.read_text()
        self.tree, self.lines = ast.parse(self.text), self.text.splitlines()
        self.where = str(path.relative_to(ROOT))
        self.name = ".".join([ROOT.name, *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(".__init__")

    @cached_property
    def nodes(self) -> list[ast.AST]:
        return list(ast.walk(self.tree))

    @cached_property
    def used(self) -> set[str]:
        """Names in the code, without names that are only imported."""
        return {n.id for n in self.nodes if isinstance(n, ast.Name)} | {
            n.name for n in self.nodes if isinstance(n, ast.ClassDef)
        }

    def beside(self, node: ast.stmt) -> str:
        """Return the comments on the lines of a statement and above it, and the string below the statement."""
        first, last = node.lineno - 1, node.end_lineno
        said = [line.partition("#")[2] for line in self.lines[first:last]]
        while first > 0 and self.lines[first - 1].lstrip().startswith("#"):
            first -= 1
            said.insert(0, self.lines[first].lstrip(" #"))
        body = self.tree.body
        after = body[body.index(node) + 1 :][:1] if node in body else []
        if after and isinstance(after[0], ast.Expr) and isinstance(after[0].value, ast.Constant):
            said.append(str(after[0].value.value))
        return " ".join(" ".join(said).split())


@cache
def modules() -> tuple[Module, ...]:
    return tuple(Module(path) for path in sorted(ROOT.rglob("*.py")))


def literals(node: ast.AST):
    """Yield the numbers in an expression, except truth values."""
    return (m for m in ast.walk(node) if isinstance(m, ast.Constant) and type(m.value) in (int, float))


def power_of_two(node: ast.AST) -> bool:
    """Return whether an expression is 2**k or 1 << k, or one less, as for sizes of chunks and of number formats."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return power_of_two(node.left)
    return isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow | ast.LShift) and integers(node)


def integers(node: ast.AST) -> bool:
    return all(type(m.value) is int and not (isinstance(m.value, bool)) for m in literals(node))


def table(node: ast.AST) -> bool:
    """Return whether an expression is a table of indices or names: nested lists of integers with several levels."""
    inner = [m for m in ast.walk(node) if m is not node and isinstance(m, ast.Tuple | ast.List | ast.Dict | ast.Set)]
    rows = isinstance(node, ast.Tuple | ast.List) and len(node.elts) > 1
    names = any(isinstance(m, ast.Constant) and isinstance(m.value, str) for m in ast.walk(node))
    return integers(node) and (bool(inner) or rows or names)


def pairs(node: ast.Assign):
    """Yield (name, value) of an assignment to one or several names."""
    for target in node.targets:
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            yield from ((a.id, b) for a, b in zip(target.elts, node.value.elts, strict=True) if isinstance(a, ast.Name))
        elif isinstance(target, ast.Name):
            yield target.id, node.value


def structure(value: ast.AST) -> bool:
    """Return whether the numbers of a value at module level are structure."""
    written = [m.value for m in literals(value)]
    harmless = all(v in (0, 1) for v in written)  # `not x[0]`, slices
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "slice":
        return True
    code = any(isinstance(m, ast.Lambda | ast.comprehension | ast.JoinedStr | ast.Subscript) for m in ast.walk(value))
    return not written or harmless or code or power_of_two(value) or table(value)


def named():
    """Yield (place, name, comments) of all numbers with names in capitals that are not structure."""
    for module in modules():
        for node in module.tree.body:
            if isinstance(node, ast.AnnAssign) and node.value is not None:
                found = [(node.target.id, node.value)] if isinstance(node.target, ast.Name) else []
            else:
                found = list(pairs(node)) if isinstance(node, ast.Assign) else []
            for name, value in found:
                if name.lstrip("_").isupper() and not structure(value):
                    yield f"{module.where}:{node.lineno}", name, module.beside(node)


def plateau(said: str):
    """Return (scene, change with half, change with twice, change with finer cells) from a comment, or None."""
    found = PLATEAU.search(said)
    return found and (found[1], *map(float, found.groups()[1:]))


def sourced(said: str) -> bool:
    """Return whether the comments of a number have a source, or a plateau with an effect below that of finer cells."""
    flat = plateau(said)
    return bool(SOURCE.search(said)) or bool(flat and 0 < max(flat[1:3]) < flat[3])


def ad_hoc() -> list[str]:
    return [f"{where} {name}" for where, name, said in named() if not sourced(said)]


def inline() -> list[str]:
    """Return the rules among the numbers in functions: no small fractions, no units, no defaults of parameters."""
    out = []
    for module in modules():
        within = [n for n in module.nodes if isinstance(n, ast.FunctionDef | ast.Lambda)]
        chosen = {m for f in within for d in [*f.args.defaults, *f.args.kw_defaults] if d for m in literals(d)}
        styles = {m for n in module.nodes if isinstance(n, ast.keyword) and n.arg in STYLES for m in literals(n)}
        checks = {m for n in module.nodes if isinstance(n, ast.Compare) and len(n.ops) > 1 for m in literals(n)}
        factors = {
            m
            for n in module.nodes
            if isinstance(n, ast.BinOp) and isinstance(n.op, ast.Mult)
            for m in (n.left, n.right)
        }
        texts = {m for n in module.nodes if isinstance(n, ast.JoinedStr) for m in literals(n)}
        for number in {m for f in within for m in literals(f)} - chosen - styles - checks - texts:
            v, line = abs(number.value), module.lines[number.lineno - 1]
            whole = type(number.value) is int
            most = 8 if number in factors else 100
            rule = v not in UNITS and (v > most if whole else (v * 8 % 1 != 0 or v > 8))
            if rule and not SOURCE.search(line):
                out.append(f"{module.where}:{number.lineno} {number.value}")
    return sorted(set(out))


def imports() -> dict[str, set[str]]:
    """Return the modules of the package that each module imports."""
    names = {module.name for module in modules()}
    out: dict[str, set[str]] = {name: set() for name in names}
    for module in modules():
        for node in module.nodes:
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(ROOT.name):
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & names
                out[module.name] |= inner or {node.module}
    return out


def folders() -> dict[str, set[str]]:
    """Return the folders that each folder imports from."""
    out: dict[str, set[str]] = {}
    rooms = {path.name for path in ROOT.iterdir() if path.is_dir()}
    for name, found in imports().items():
        own = [*name.split("."), ""][1]
        if own in rooms:
            out.setdefault(own, set()).update({other.split(".")[1] for other in found} & rooms - {own})
    return out


def cycles(graph: dict[str, set[str]]) -> list[str]:
    """Return the nodes of a circle in a graph, or an empty list."""
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        return error.args[1]
    return []


def parameters() -> list[tuple[int, str]]:
    """Return (number of parameters, name) of all functions and data classes, in descending order."""
    out = []
    for module in modules():
        for node in module.nodes:
            if isinstance(node, ast.FunctionDef):
                a = node.args
                count = sum(arg.arg != "self" for arg in [*a.posonlyargs, *a.args, *a.kwonlyargs])
                out.append((count, f"{module.where}:{node.lineno} {node.name}"))
    return sorted(out, reverse=True)


def packed() -> list[str]:
    """Return the assignments of three or more values to as many names in one statement."""
    found = []
    for module in modules():
        for node in module.nodes:
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
                if any(isinstance(t, ast.Tuple) and len(t.elts) > 2 for t in node.targets):
                    found.append(f"{module.where}:{node.lineno}")
    return found


def _slot(index: ast.AST) -> bool:
    """Return whether a subscript is [0], [()] or [:], so that a container replaces an attribute."""
    whole = isinstance(index, ast.Slice) and index.lower is index.upper is index.step is None
    empty = isinstance(index, ast.Tuple) and not index.elts
    return whole or empty or (isinstance(index, ast.Constant) and index.value == 0)


def hidden() -> list[str]:
    """Return the places where a method changes contents of its object without setting an attribute, or a function
    changes a global.

    Such changes are: `self.x[0] += 1`, `self.x[:] = y`, `self.x[()] = y`; `self._x.append`, clear, update, pop and add
    outside of `__init__`; `global`; attributes of functions; entries set in the lists and dictionaries of a module.
    """
    out = []
    for module in modules():
        functions = {n.name for n in module.nodes if isinstance(n, ast.FunctionDef)}
        for method in (n for n in module.nodes if isinstance(n, ast.FunctionDef) and n.name != "__init__"):
            for node in ast.walk(method):
                if _changes(node, functions):
                    out.append(f"{module.where}:{node.lineno} {ast.unparse(node).splitlines()[0]}")
    return sorted(set(out))


def _of_self(node: ast.AST) -> bool:
    return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "self"


def _changes(node: ast.AST, functions: set[str]) -> bool:
    if isinstance(node, ast.Global):
        return True
    for target in getattr(node, "targets", [getattr(node, "target", None)]):
        if isinstance(target, ast.Subscript) and _of_self(target.value) and _slot(target.slice):
            return isinstance(node, ast.Assign | ast.AugAssign)
        if isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name) and target.value.id in functions:
            return not target.attr.startswith("__") and isinstance(node, ast.Assign | ast.AugAssign)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and _of_self(node.func.value):
        private = node.func.value.attr.startswith("_")
        return private and node.func.attr in ("append", "clear", "extend", "pop", "setdefault", "insert")
    return False


def guards() -> list[str]:
    """Return asserts and RuntimeErrors that guard the order of calls, and are not caused by users or solvers."""
    found = []
    for module in modules():
        for node in module.nodes:
            if isinstance(node, ast.Assert) or (isinstance(node, ast.Raise) and "RuntimeError(" in ast.unparse(node)):
                found.append(f"{module.where}:{node.lineno} {ast.unparse(node)}")
    return found


def rooms(name: str) -> list[str]:
    """Return the modules that use the name of a class, without modules that only export it."""
    return [m.where for m in modules() if m.path.name != "__init__.py" and name in m.used]


def lines() -> int:
    return sum(len(module.lines) for module in modules())


def measures() -> dict[str, float]:
    """Return all measures by name."""
    size: dict[Path, int] = {}
    for module in modules():
        size[module.path.parent] = size.get(module.path.parent, 0) + 1
    arrows = imports()
    return {
        "ad hoc named numbers": len(ad_hoc()),
        "rules among numbers in functions": len(inline()),
        "lines of the package": lines(),
        "imports a file, mean": round(sum(map(len, arrows.values())) / len(arrows), 2),
        "files in a circle of imports": len(cycles(arrows)),
        "folders in a circle of imports": len(cycles(folders())),
        "files of the largest folder": max(size.values()),
        "parameters of the longest list": parameters()[0][0],
        "assignments of three and more values": len(packed()),
        "changes of hidden state": len(hidden()),
        "asserts and RuntimeErrors": len(guards()),
        "files that name a condition's class, most": max(len(rooms(name)) for name in CONDITIONS),
    }


def main(arguments: list[str]) -> None:
    """Print the measures. With --list, also print the counted places."""
    for name, value in measures().items():
        print(f"{value:9g}  {name}")
    if "--list" in arguments:
        every = {"ad hoc": ad_hoc(), "inline": inline(), "hidden": hidden(), "packed": packed()}
        every["guards"] = guards()
        every["sourced"] = [f"{where} {name}: {said}" for where, name, said in named() if sourced(said)]
        every["parameters"] = [f"{n} {what}" for n, what in parameters()[:10]]
        every["conditions"] = [f"{name}: {', '.join(rooms(name))}" for name in CONDITIONS]
        for title, found in every.items():
            print(f"\n{title} ({len(found)})", *found, sep="\n    ")


if __name__ == "__main__":
    main(sys.argv[1:])
