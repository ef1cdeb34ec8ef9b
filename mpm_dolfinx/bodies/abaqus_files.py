# SPDX-License-Identifier: MIT
"""Reader of input files of Abaqus and CalculiX: cells, element sets, surfaces, and the positions of instances.

The reader of meshio keeps only the nodes of the last part, and ignores the positions of instances.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.bodies.mesh_cells import Block

PLANE = re.compile(r"(?:(?:C|DC|DCC|EC)?(?:PE|PS|PEG|AX|GAX|2D)|AC(?:2D|AX)|S|STRI|DS|M3D|SFM3D|R3D)(3|4|6|8|9)(?!\d)")
SOLID = re.compile(r"(?:(?:C|DC|DCC|EC|AC|Q)3D|SC)(4|5|6|8|10|13|15|20|27)(?![\dV])")
LINE = re.compile(r"(?:T2D|T3D|R2D|RAX|DC1D|AC1D)(2|3)|(?:B|PIPE|SAX)[23]?([123])")
"""Pattern of the names of line elements.  Group 1 of a match is the number of nodes, group 2 the order of a beam."""
NO_CELL = ("SPRING", "DASHPOT", "MASS", "ROTARY", "CONN", "GAP", "JOINT", "HEATCAP", "DCOUP", "ITS", "DIST", "FRAME")
"""Prefixes of the names of elements without volume or area."""
KINDS = {
    **{("plane", 3): "triangle", ("plane", 4): "quad", ("plane", 6): "triangle6", ("plane", 8): "quad8"},
    **{("plane", 9): "quad9", ("solid", 4): "tetra", ("solid", 5): "pyramid", ("solid", 6): "wedge"},
    **{("solid", 8): "hexahedron", ("solid", 10): "tetra10", ("solid", 13): "pyramid13", ("solid", 15): "wedge15"},
    **{("solid", 20): "hexahedron20", ("solid", 27): "hexahedron27", ("line", 2): "line", ("line", 3): "line3"},
}
FACES = {
    "triangle": ["12", "23", "31"],
    "quad": ["12", "23", "34", "41"],
    "tetra": ["123", "142", "243", "341"],
    "pyramid": ["1234", "152", "253", "354", "451"],
    "wedge": ["123", "465", "1452", "2563", "3641"],
    "hexahedron": ["1234", "5876", "1562", "2673", "3784", "4851"],
}
"""Vertices of the element faces S1, S2, ..."""
MAKES = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM", "SYMMETRIC MODEL GENERATION", "IMPORT")
"""Keywords that generate or move nodes and elements."""


@dataclass
class _Set:
    """A set of elements of one or several instances."""

    name: str
    internal: bool
    entries: list[tuple[str, NDArray[np.int64] | str]] = field(default_factory=list)


@dataclass
class _Scope:
    """Nodes, elements, sets and surfaces that are defined in one part, or outside all parts."""

    name: str = ""
    nodes: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=list)  # numbers (n,), x (n, 3)
    # cell type, element numbers (m,), node numbers (m, k)
    cells: list[tuple[str, NDArray[np.int64], NDArray[np.int64]]] = field(default_factory=list)
    sets: dict[str, _Set] = field(default_factory=dict)
    # name, and pairs (set or element, face)
    surfaces: dict[str, tuple[str, list[tuple[str, str]]]] = field(default_factory=dict)

    def entry(self, options: Mapping[str, str], instance: str, rows: NDArray[np.int64] | str) -> None:
        """Add element numbers, or the name of another set, to a set of elements."""
        name = options["ELSET"]
        self.sets.setdefault(name.upper(), _Set(name, "INTERNAL" in options)).entries.append((instance.upper(), rows))


@dataclass
class _Placed:
    """Definitions of a part, and the position and rotation of one instance."""

    scope: _Scope
    name: str = ""
    shift: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    rotation: tuple[float, ...] = ()

    def places(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the node positions of an instance: nodes of the part are translated, and then rotated."""
        x = x + self.shift
        if not self.rotation:
            return x
        a = np.array(self.rotation[:3])
        b = np.array(self.rotation[3:6])
        angle = np.deg2rad(self.rotation[6])
        k, r = (b - a) / np.linalg.norm(b - a), x - a
        return a + r * np.cos(angle) + np.cross(k, r) * np.sin(angle) + np.outer(r @ k, k) * (1 - np.cos(angle))


def is_abaqus(file: Path) -> bool:
    """Return whether a file with the suffix `.inp` has Abaqus keywords.  AVS files have the same suffix."""
    if file.suffix.lower() != ".inp" or not file.is_file():
        return False
    with file.open(errors="replace") as lines:
        return any(re.match(r"\s*\*\s*[A-Za-z]", line) for line in lines)


def read(file: Path) -> meshio.Mesh:
    """Return the mesh of an input file.  Element sets and instances become parts, and surfaces become sides."""
    return _assembled(_placed(file))


def _keywords(file: Path) -> Iterator[tuple[str, dict[str, str], list[str]]]:
    """Yield each keyword of a file and of its included files, with its options and data lines."""
    keyword, rows = "", []
    with file.open(errors="replace") as lines:
        for line in map(str.strip, lines):
            if line.startswith("**") or not line:
                continue
            if line.startswith("*"):
                yield from _keyword(file, keyword, rows)
                keyword, rows = line, []
            elif keyword.endswith(",") and not rows:  # continuation line
                keyword += line
            else:
                rows.append(line)
    yield from _keyword(file, keyword, rows)


def _keyword(file: Path, line: str, rows: list[str]) -> Iterator[tuple[str, dict[str, str], list[str]]]:
    """Yield one keyword, or all keywords of an included file."""
    name, *words = line.lstrip("*").split(",")
    pairs = [word.partition("=")[::2] for word in words if word.strip()]
    options = {key.strip().upper(): value.strip().strip('"') for key, value in pairs}
    name = " ".join(name.upper().split())
    other = file.parent / options.get("INPUT", "")
    if name == "INCLUDE":
        yield from _keywords(other)
    elif name:
        if "INPUT" in options and name in ("NODE", "ELEMENT", "ELSET"):
            rows = [row.strip() for row in other.read_text(errors="replace").splitlines()]
            rows = [row for row in rows if row and not row.startswith("*")]
        yield name, options, rows


def _placed(file: Path) -> list[_Placed]:
    """Return the definitions outside parts, and all instances.  In files without instances, return all parts."""
    whole = _Scope()
    scope = whole
    parts = {}
    instances = []
    for keyword, options, rows in _keywords(file):
        if keyword in MAKES:
            raise ValueError(f"*{keyword}: the file must list nodes and elements one by one, as files of Abaqus/CAE do")
        if keyword == "PART":
            scope = parts[options["NAME"].upper()] = _Scope(options["NAME"])
        elif keyword == "INSTANCE":
            if "PART" not in options or options["PART"].upper() not in parts:
                what = f"*INSTANCE {options.get('NAME', '')}: part {options.get('PART', 'none')!r}"
                raise ValueError(f"{what}, must be a part of the file: {', '.join(p.name for p in parts.values())}")
            of = parts[options["PART"].upper()]
            scope = deepcopy(of)
            shift, turn = ([float(v) for v in row.split(",") if v.strip()] for row in (*rows, "", "")[:2])
            if len(shift) > 3 or len(turn) not in (0, 7):
                what = f"*INSTANCE {options['NAME']}: translation of {len(shift)} and rotation of {len(turn)} numbers"
                raise ValueError(f"{what}, must be at most 3 for the translation, and 0 or 7 for the rotation")
            instances.append(_Placed(scope, options["NAME"], np.array((*shift, 0.0, 0.0, 0.0)[:3]), tuple(turn)))
        elif keyword in ("END PART", "END INSTANCE"):
            scope = whole
        else:
            try:
                _define(scope, keyword, options, rows)
            except KeyError as error:
                raise ValueError(f"*{keyword}: option {error.args[0]} is missing, must be given") from None
    return [_Placed(whole), *(instances or [_Placed(part, part.name) for part in parts.values()])]


def _define(scope: _Scope, keyword: str, options: dict[str, str], rows: list[str]) -> None:
    """Add the nodes, elements, sets or surfaces of one keyword to a scope."""
    if keyword in DEFINED:
        DEFINED[keyword](scope, options, rows)


def _add_nodes(scope: _Scope, options: dict[str, str], rows: list[str]) -> None:
    if not rows:
        return
    if options.get("SYSTEM", "R").upper() != "R":
        raise ValueError(f"*NODE, SYSTEM={options['SYSTEM']}: coordinates must be Cartesian")
    rows = [row.upper().replace("D", "E") + ",0,0,0" for row in rows]  # exponents as in Fortran, 1D3
    x = np.array([[float(v.strip() or 0) for v in row.split(",")[:4]] for row in rows])
    scope.nodes.append((x[:, 0].astype(np.int64), x[:, 1:]))


def _add_elements(scope: _Scope, options: dict[str, str], rows: list[str]) -> None:
    if not rows:
        return
    numbers = np.empty(0, np.int64)
    if kind := _kind(options["TYPE"]):  # elements with volume or area
        values, width = np.array([int(v) for row in rows for v in row.split(",") if v.strip()]), 1 + _nodes(kind)
        if len(values) % width:
            what = f"*ELEMENT, TYPE={options['TYPE']}: {len(values)} numbers"
            raise ValueError(f"{what}, must be {width} for each element")
        table = values.reshape(-1, width)
        numbers = table[:, 0]
        nodes = table[:, [1, 3, 2]] if kind == "line3" else table[:, 1:]  # the second node is the middle in Abaqus
        scope.cells.append((kind, numbers, nodes))
    if "ELSET" in options:
        scope.entry(options, "", numbers)


def _add_set(scope: _Scope, options: dict[str, str], rows: list[str]) -> None:
    words = [[v for v in map(str.strip, row.split(",")) if v] for row in rows]
    if "GENERATE" in options:
        spans = [[*map(int, row), 1][:3] for row in words]
        words = [[str(v) for v in range(a, b + 1, step)] for a, b, step in spans]
    words = [v.strip('"') for row in words for v in row]
    numbers = [int(v) for v in words if v.isdigit()]
    scope.entry(options, options.get("INSTANCE", ""), np.array(numbers, dtype=np.int64))
    for word in (v for v in words if not v.isdigit()):
        instance, _, name = word.rpartition(".")
        instance = instance or options.get("INSTANCE", "")
        scope.entry(options, instance, np.array([int(name)]) if name.isdigit() else name.upper())


def _add_surface(scope: _Scope, options: dict[str, str], rows: list[str]) -> None:
    if options.get("TYPE", "ELEMENT").upper() == "ELEMENT" and "COMBINE" not in options:
        pairs = [(*(v.strip() for v in row.split(",")), "")[:2] for row in rows]
        scope.surfaces[options["NAME"].upper()] = options["NAME"], pairs


DEFINED = {"NODE": _add_nodes, "ELEMENT": _add_elements, "ELSET": _add_set, "SURFACE": _add_surface}
"""Functions that add the rows of a keyword to a scope."""


def _kind(name: str) -> str:
    """Return meshio's name of an element type, or "" for elements without volume or area."""
    name = name.upper()
    if name.startswith(NO_CELL):
        return ""
    if name == "STRI65":
        return "triangle6"
    for what, pattern in (("plane", PLANE), ("solid", SOLID)):
        if found := pattern.match(name):
            return KINDS[what, int(found[1])]
    if found := LINE.match(name):
        return KINDS["line", int(found[1] or {"1": 2, "2": 3, "3": 2}[found[2]])]
    raise ValueError(f"*ELEMENT, TYPE={name}: must be an element of a plane or solid body, such as CPE4P, CAX4, C3D8P")


def _nodes(kind: str) -> int:
    """Return the number of nodes of a cell type."""
    return next(of for (_, of), found in KINDS.items() if found == kind)


def _assembled(placed: list[_Placed]) -> meshio.Mesh:
    """Return the cells of all parts or instances as one mesh."""
    x = [np.empty((0, 3))]
    cells = []
    numbers = []
    start = 0
    for k, one in enumerate(placed):
        places = one.places(np.concatenate([np.empty((0, 3)), *(p for _, p in one.scope.nodes)]))
        known, where = _unique([of for of, _ in one.scope.nodes], "node", places)
        for kind, number, rows in one.scope.cells:
            at = np.minimum(np.searchsorted(known, rows), max(0, len(known) - 1))
            missing = rows[known[at] != rows] if len(known) else rows
            if missing.size:
                raise ValueError(f"*ELEMENT: node {missing.flat[0]} is undefined, must be a number given under *NODE")
            cells.append((kind, start + where[at]))
            numbers.append((k, number))
        _unique([number for of, number in numbers if of == k], "element")
        x.append(places)
        start += len(places)
    groups = _groups(placed, cells, numbers)
    mesh = meshio.Mesh(np.concatenate(x), [], cell_sets=groups)
    mesh.cells = [Block(*block) for block in cells]
    return mesh


def _unique(
    numbers: list[NDArray[np.int64]], what: str, x: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted node or element numbers, and the permutation that sorts them.

    Repeated numbers raise ValueError.  Two nodes may have the same number if their positions are equal.
    """
    numbers = np.concatenate([np.empty(0, np.int64), *numbers])
    order = np.argsort(numbers, kind="stable")
    same = np.diff(numbers[order]) == 0
    if x is not None:
        same &= (np.diff(x[order], axis=0) != 0).any(axis=1)
    same = np.flatnonzero(same)
    if len(same):
        raise ValueError(f"{what} {numbers[order][same[0]]} occurs twice in one part, must occur once")
    return numbers[order], order


def _groups(placed: list[_Placed], cells: list, numbers: list) -> dict[str, list[NDArray[np.int64]]]:
    """For each name of an instance, element set or surface, return its cells in each block of cells."""
    chosen: dict[str, list[tuple[int, NDArray[np.int64]]]] = {}
    seen = [[k for k, of in one.scope.sets.items() if not (of.internal and k.startswith("_"))] for one in placed]
    for k, one in enumerate(placed):
        if one.name:
            chosen.setdefault(one.name, []).extend((k, of) for at, of in numbers if at == k)
        for key in seen[k]:
            name, rows = one.scope.sets[key].name, _members(placed, k, key)
            chosen.setdefault(name, []).extend(rows)
            if one.name and sum(key in other for other in seen) > 1:
                chosen.setdefault(f"{one.name}.{name}", []).extend(rows)
    out = {}
    for name, rows in chosen.items():
        of = [np.concatenate([np.empty(0, np.int64), *(r for at, r in rows if at == k)]) for k in range(len(placed))]
        out[name] = [np.flatnonzero(np.isin(number, of[k])) for k, number in numbers]
    facets = _surfaces(placed, cells, numbers)
    for name, kind, rows in facets:
        out.setdefault(name, [[] for _ in cells]).extend([[]] * (len(cells) - len(out[name])) + [np.arange(len(rows))])
        cells.append((kind, rows))
    return {name: [*rows, *([[]] * (len(cells) - len(rows)))] for name, rows in out.items()}


def _members(
    placed: list[_Placed], k: int, key: str, above: tuple[str, ...] = ()
) -> list[tuple[int, NDArray[np.int64]]]:
    """Return the elements of a set: the index of each instance or part, and its element numbers."""
    out = []
    if key not in placed[k].scope.sets or key in above:
        known = ", ".join(found.name for found in placed[k].scope.sets.values()) or "none"
        raise ValueError(f"element set {key!r}, must be a set of {placed[k].name or 'the file'}: {known}")
    for instance, rows in placed[k].scope.sets[key].entries:
        at = next((i for i, one in enumerate(placed) if one.name.upper() == instance), None) if instance else k
        if at is None:
            raise ValueError(f"set {key!r} refers to instance {instance!r}, must be an instance of the file")
        out += _members(placed, at, rows, (*above, key) if at == k else ()) if isinstance(rows, str) else [(at, rows)]
    return out


def _surfaces(placed: list[_Placed], cells: list, numbers: list) -> Iterator[tuple[str, str, NDArray[np.int64]]]:
    """Return the name of each surface, with the cell type and the nodes of its facets."""
    out: dict[tuple[str, str], list[NDArray[np.int64]]] = {}
    for k, one in enumerate(placed):
        for name, pairs in one.scope.surfaces.values():
            for of, face in pairs:
                if face and not re.fullmatch(r"[sS]\d", face):
                    continue  # a face of a shell
                instance, _, key = of.rpartition(".")
                at = next((i for i, p in enumerate(placed) if instance and p.name.upper() == instance.upper()), k)
                key = key if at != k else of
                rows = [(at, np.array([int(key)]))] if key.isdigit() else _members(placed, at, key.upper())
                for (where, number), (kind, nodes) in zip(numbers, cells, strict=True):
                    base = kind.rstrip("0123456789")
                    inside = np.isin(
                        number, np.concatenate([np.empty(0, np.int64), *(r for a, r in rows if a == where)])
                    )
                    loops = FACES.get(base, [])
                    for loop in loops[int(face[1]) - 1 : int(face[1])] if face else loops:
                        corners = nodes[inside][:, [int(v) - 1 for v in loop]]
                        out.setdefault((name, {2: "line", 3: "triangle", 4: "quad"}[len(loop)]), []).append(corners)
    return [(name, kind, np.concatenate(rows)) for (name, kind), rows in out.items()]
