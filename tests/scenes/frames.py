# SPDX-License-Identifier: MIT
"""Transformations that must not change the results of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx.grid.grid import SIDES
from scenes.description import AXES, Draw, Scene

FAR_BODIES = ("resting", "moving", "stiff", "draining", "yielding", "incompressible", "tight")
"""Kinds of far bodies; those of other laws show decisions that are made for the whole scene."""


@dataclass(frozen=True)
class Frame:
    """How a scene is built.

    axes, signs : (d,) — axis k is axis axes[k] of the description, times signs[k]; cells : (d,) — by which it is
    carried, in cells; length, stress, time: factors of the units; order: seed by which bodies, materials, conditions,
    walls and nodes of meshes are shuffled, 0: as they are; far: kind of a body that lies far above; cut: whether the
    run goes on from a checkpoint; load: factor of all loads, to see how much a scene makes of a disturbance.
    """

    axes: tuple[int, ...]
    signs: tuple[int, ...]
    cells: tuple[float, ...]
    length: float = 1.0
    stress: float = 1.0
    time: float = 1.0
    order: int = 0
    far: str | None = None
    cut: bool = False
    load: float = 1.0

    @classmethod
    def plain(cls, dim: int) -> Frame:
        """Return the frame of the description."""
        return cls(tuple(range(dim)), (1,) * dim, (0.0,) * dim)

    # ---- places and directions --------------------------------------------------------------

    @property
    def dim(self) -> int:
        return len(self.axes)

    def vector(self, v) -> NDArray[np.float64]:
        """Return vectors (..., d) of the description in this frame; infinite components do not change."""
        return np.asarray(v, dtype=float)[..., list(self.axes)] * self.signs

    def vector_back(self, v) -> NDArray[np.float64]:
        """Return vectors (..., d) of this frame in the description."""
        return (np.asarray(v, dtype=float) * self.signs)[..., np.argsort(self.axes)]

    def tensor_back(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return tensors (n, 3, 3) of this frame in the description; in 2D the third axis stays."""
        axes, signs = [*self.axes, 2][:3], np.array([*self.signs, 1])[:3]
        back = np.argsort(axes)
        return (s * signs[:, None] * signs)[:, back][:, :, back]

    def shift(self, scene: Scene) -> NDArray[np.float64]:
        """Return by how much the scene is carried (d,), in the description's lengths, along this frame's axes."""
        return np.array(self.cells) * np.abs(self.vector(scene.h))

    def place(self, x, scene: Scene) -> NDArray[np.float64]:
        """Return places (..., d) of the description in this frame."""
        return (self.vector(x) + self.shift(scene)) * self.length

    def place_back(self, x, scene: Scene) -> NDArray[np.float64]:
        """Return places (..., d) of this frame in the description."""
        return self.vector_back(np.asarray(x) / self.length - self.shift(scene))

    def box(self, lower, upper, scene: Scene) -> NDArray[np.float64]:
        """Return the corners (2, d) of a box of the description in this frame."""
        return np.sort(self.place([lower, upper], scene), axis=0)

    def side(self, name: str) -> str:
        """Return the name that a side of the description has in this frame."""
        axis, end = SIDES[self.dim][name]
        new = self.axes.index(axis)
        end = end if self.signs[new] > 0 else 1 - end
        return next(side for side, value in SIDES[self.dim].items() if value == (new, end))

    def components(self, letters: str) -> str:
        """Return components of the description in this frame."""
        return "".join(sorted(AXES[self.axes.index(AXES.index(c))] for c in letters))

    # ---- units ------------------------------------------------------------------------------

    @property
    def density(self) -> float:
        return self.stress * self.time**2 / self.length**2

    def force(self, scene: Scene) -> float:
        """Return the factor of forces; in plane strain they act on a slice of unit thickness."""
        plane = scene.dim == 2 and not scene.axisymmetric
        return self.stress * (self.length if plane else self.length**2)

    def flow(self, scene: Scene) -> float:
        """Return the factor of outflows."""
        plane = scene.dim == 2 and not scene.axisymmetric
        return self.length ** (2 if plane else 3) / self.time

    @property
    def turn(self) -> float:
        """Return the factor of angles in the plane: -1 where left and right change places."""
        return float(np.linalg.det(np.eye(self.dim)[list(self.axes)] * self.signs))

    def mass(self, scene: Scene) -> float:
        """Return the factor of masses of tools."""
        return self.force(scene) * self.time**2 / self.length

    # ---- which there are --------------------------------------------------------------------

    def named(self) -> dict[str, Frame]:
        """Return this frame's transformations one by one, by their names."""
        out, plain = {}, Frame.plain(self.dim)
        groups = {
            "turned": ("axes", "signs"),
            "carried": ("cells",),
            "length": ("length",),
            "stress": ("stress",),
            "time": ("time",),
            "order": ("order",),
            "far": ("far",),
            "checkpoint": ("cut",),
        }
        for name, of in groups.items():
            changes = {f: getattr(self, f) for f in of if getattr(self, f) != getattr(plain, f)}
            if changes:
                if name == "turned":
                    mirrored = self.axes == plain.axes
                    name = "mirrored" if mirrored else "turned"
                out[f"far {self.far}" if name == "far" else name] = replace(plain, **changes)
        return out

    def __str__(self) -> str:
        plain = Frame.plain(self.dim)
        changed = {f.name: getattr(self, f.name) for f in fields(self)}
        return ", ".join(f"{k}={v}" for k, v in changed.items() if v != getattr(plain, k)) or "as it is"


def turns(scene: Scene) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the axes and signs of all turns and mirrors that a scene allows."""
    d, out = scene.dim, []
    for axes in permutations(range(d)):
        for bits in range(2**d):
            signs = tuple(1 - 2 * (bits >> k & 1) for k in range(d))
            upright = axes[-1] == d - 1 and signs[-1] == 1
            if scene.axisymmetric and (axes != (0, 1) or signs[0] < 0):
                continue
            if scene.initial == "K0" and not upright:  # which knows what is above by the last axis
                continue
            out.append((axes, signs))
    return out


def bears_far(scene: Scene) -> bool:
    """Return whether a far body leaves a scene alone.

    Sources feed it, tools reach it, steps by error see it, an initial stress is brought into balance with it, and sides
    are tied to its own.
    """
    if any(c.kind == "tied" for c in scene.conditions):
        return False
    return not scene.rate and not scene.tools and scene.rtol is None and scene.initial is None


def composite(scene: Scene, seed: int) -> Frame:
    """Return a frame that changes at random all that may be changed."""
    draw, d = Draw([scene.seed, seed, 1]), scene.dim
    choices = turns(scene)
    axes, signs = choices[draw.whole(0, len(choices) - 1)]
    carried = [1e4, -3e4, 2e4][:d] if draw.yes(0.7) else [0.0] * d
    if scene.axisymmetric:
        carried[0] = 0.0
    far = draw.one(*FAR_BODIES) if draw.yes(0.6) and bears_far(scene) else None
    return Frame(
        axes,
        signs,
        tuple(carried),
        length=draw.one(1.0, 1e-4, 1e3),
        stress=draw.one(1.0, 1e-3, 1e3),
        time=draw.one(1.0, 1e-5, 1e3),
        order=draw.whole(1, 10**6) if draw.yes(0.7) else 0,
        far=far,
        cut=scene.rtol is None and draw.yes(0.3),
    )


def every(scene: Scene) -> Iterator[tuple[str, Frame]]:
    """Yield each transformation by itself with its name."""
    plain, d = Frame.plain(scene.dim), scene.dim
    for axes, signs in turns(scene):
        if (axes, signs) != (plain.axes, plain.signs):
            kind = "mirrored" if axes == plain.axes else "turned"
            yield f"{kind} {axes} {signs}", replace(plain, axes=axes, signs=signs)
    cells = (0.0, *[1e4, -3e4, 2e4][1:d]) if scene.axisymmetric else (1e4, -3e4, 2e4)[:d]
    yield "carried", replace(plain, cells=cells)
    for name, values in {"length": (1e-4, 1e3), "stress": (1e-3, 1e3), "time": (1e-5, 1e3)}.items():
        for value in values:
            yield f"{name} {value:g}", replace(plain, **{name: value})
    yield "order", replace(plain, order=1)
    if scene.rtol is None:
        yield "checkpoint", replace(plain, cut=True)
        for far in FAR_BODIES if bears_far(scene) else ():
            yield f"far {far}", replace(plain, far=far)
