# SPDX-License-Identifier: MIT
"""Differences between two runs of a scene, and the amplification of a disturbance by a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from mpm_dolfinx.conditions.conditions import HOLD
from mpm_dolfinx.contact.law import STIFF
from scenes.description import Scene
from scenes.frames import Frame
from scenes.running import Shown

SAME = 1e-5  # of a cell: places of points at rest that are one
LEAST = 1e-4  # cells: what moves less does not move
NOTHING = 1e-8  # of the shear modulus: stresses below which there are none


def differences(scene: Scene, one: Sequence[Shown], other: Sequence[Shown]) -> dict[str, float]:
    """Return the largest difference of each field over the largest value that it has in the scene."""
    out: dict[str, float] = {}
    scales = _scales(scene, one)
    for a, b in zip(one, other, strict=True):
        if a.place.shape != b.place.shape:
            return {"points": np.inf}
        distance, at = cKDTree(b.place).query(a.place)
        if distance.max() > SAME * min(scene.h) or len(np.unique(at)) < len(at):
            return {"points": np.inf}
        for name, values in a.fields.items():
            if name not in b.fields:  # a far body has energies of its own
                continue
            others = b.fields[name][at] if len(values) == len(at) and name in OF_POINTS else b.fields[name]
            if values.shape != others.shape:
                return {name: np.inf}
            off = np.abs(np.nan_to_num(values, nan=-1.0) - np.nan_to_num(others, nan=-1.0)).max(initial=0.0)
            out[name] = max(out.get(name, 0.0), off / scales[name])
    return out


OF_POINTS = ("displacement", "velocity", "stress", "volume", "pressure", "saturation")


def softest(scene: Scene) -> float:
    """Return the least shear modulus, Pa."""
    return min(law["shear"] for _, law in scene.materials)


def _seeps(scene: Scene) -> float:
    """Return the flow through a unit area under gravity alone, m/s."""
    return max(law.get("conductivity", 0.0) for _, law in scene.materials) if scene.gravity else 0.0


def _scales(scene: Scene, run: Sequence[Shown]) -> dict[str, float]:
    """Return the largest value of each field; for zero fields a small fraction of a reference value."""

    def most(name: str) -> float:
        return max(float(np.nanmax(np.abs(s.fields[name]), initial=0.0)) for s in run if name in s.fields)

    h, d = min(scene.h), scene.dim if not scene.axisymmetric else 3
    found = {name: most(name) for name in run[0].fields}
    stress = max(found["stress"], found.get("pressure", 0.0), NOTHING * softest(scene))
    moved = max(found["displacement"], LEAST * h)
    found |= {"displacement": moved, "stress": stress, "pressure": stress}
    found["volume"] = max(found["volume"], LEAST)
    for name in ("reactions", "tools"):
        found[name] = max(found[name], 1e-3 * stress * h ** (d - 1))
    found["outflows"] = max(found["outflows"], 1e-3 * (moved / scene.end + _seeps(scene)) * h ** (d - 1))
    if "velocity" in found:
        found["velocity"] = max(found["velocity"], moved / scene.end)
    if "rain" in found:
        found["rain"] = max(found["rain"], found["outflows"] * scene.end)
    found["travel"] = max(found["travel"], LEAST * h)
    if "rotation" in found:
        found["rotation"] = max(found["rotation"], LEAST)
    return found


def stress_of_rounding(scene: Scene) -> float:
    """Return the stress, Pa, of a strain by the last digit of a place on the grid, over a cell."""
    stiffest = max(law.get("bulk", 1e7) + 4 / 3 * law["shear"] for _, law in scene.materials)
    return np.finfo(float).eps * scene.size.max() / min(scene.h) * stiffest


def resolved(scene: Scene, frame: Frame, run: Sequence[Shown]) -> dict[str, float]:
    """Return the rounding error of coordinates in a frame for each field, over the largest value of the field.

    A position is given, and shown, to the last digit of a coordinate. Far from the origin strains thus differ by this
    digit over a cell, and displacements by the digit. On the grid a position has the last digit of the grid's size, a
    strain this over a cell, a stress the stiffest modulus times this. Supports and tools are stiffer by a factor.
    """
    scales, h, d = _scales(scene, run), min(scene.h), scene.dim if not scene.axisymmetric else 3
    most = np.abs(frame.place([np.zeros(scene.dim), scene.size], scene)).max() / frame.length
    given, place = (np.finfo(float).eps * size for size in (most, scene.size.max()))
    stress = stress_of_rounding(scene)
    out = {name: place / scales["displacement"] for name in scales}
    out |= {"displacement": given / scales["displacement"], "volume": place / h / scales["volume"]}
    flows = _seeps(scene) + h / (scene.end / scene.steps)  # what a step's rounding of a volume presses out, too
    out["outflows"] += place / h * flows * h ** (d - 1) / scales["outflows"]
    out |= {name: stress / scales[name] for name in ("stress", "pressure")}
    if "velocity" in out:
        out["velocity"] = place / (scene.end / scene.steps) / scales["velocity"]
    forces = {"reactions": HOLD, "tools": STIFF}
    out |= {name: k * stress * h ** (d - 1) / scales[name] for name, k in forces.items()}
    return {name: value + given / h for name, value in out.items()}
