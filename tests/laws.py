# SPDX-License-Identifier: MIT
"""Laws at points with arbitrary deformation gradients. pytest does not collect this file."""

from functools import cached_property

import numpy as np
import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.forms.point_forms import FormPoints, PointExpression
from mpm_dolfinx.materials.evaluate import by_scene
from mpm_dolfinx.materials.local_unknowns import LocalUnknowns


class LawAtPoints:
    """A law at points with one state, or with an array (n, ...) for each state variable."""

    def __init__(self, material, dim):
        self.material, self.law, self.dim = material, type(material), dim
        self.grid = mpm.Grid([0] * dim, [1.0] * dim, {2: [8, 8], 3: [4, 4, 4]}[dim])
        taken = {name: np.shape(getattr(material, name)) for name in self.law.parameters}
        taken |= {name: np.shape(value) for name, value in self.law.state.items()}
        self.points = FormPoints(self.grid, F=(dim, dim), **taken)
        self.F = ufl.variable(self.points.F)
        values = {name: getattr(self.points, name) for name in taken} | by_scene(self.grid)
        self.local = LocalUnknowns(self.law, self.points, self.F, values) if self.law.unknowns else None
        self.values = values | (self.local.values if self.local is not None else {})
        self.P = self.law.first_piola(self.F, self.values)
        self.stress = PointExpression(self.P, self.points)

    def evaluate(self, expression, F, state=None):
        """Return an expression at points with given F (n, d, d). `state`: name -> (n, ...), by default the state at
        rest.
        """
        n, state = len(F), {**self.law.state, **(state or {})}
        fields = {name: np.asarray(getattr(self.material, name), dtype=float) for name in self.law.parameters}
        fields = {name: np.broadcast_to(v, (n, *v.shape)) for name, v in fields.items()}
        for name, start in self.law.state.items():
            fields[name] = np.broadcast_to(state[name], (n, *np.shape(start)))
        cells = np.arange(n, dtype=np.int32) % self.grid.num_owned
        data = self.points.at(cells, self.grid.midpoints[cells], np.ones(n), F=F, **fields)
        given = {} if self.local is None else self.local.solve(data)
        return expression.evaluate(data, live=expression.live(data, given))

    def kirchhoff(self, F, state=None):
        """Return the in-plane Kirchhoff stress (n, d, d), Pa."""
        return self.evaluate(self.stress, F, state) @ F.transpose(0, 2, 1)

    @cached_property
    def _update(self):
        taken = {
            name: value
            for name, value in {"F": self.F, **self.values}.items()
            if name in self.law.arguments_of(self.law.update)
        }
        new = {name: ufl.as_ufl(value) for name, value in self.law.update(**taken).items()}
        parts = [value[i] if i else value for value in new.values() for i in np.ndindex(value.ufl_shape)]
        return PointExpression(ufl.as_vector(parts), self.points), {
            name: value.ufl_shape for name, value in new.items()
        }

    def update(self, F, state=None):
        """Return the new state, name -> (n, ...)."""
        expression, shapes = self._update
        values, out = self.evaluate(expression, F, state), {}
        for name, shape in shapes.items():
            size = int(np.prod(shape, dtype=int))
            out[name], values = values[:, :size].reshape(-1, *shape), values[:, size:]
        return out

    def tangent(self, F, state=None, h=1e-6):
        """Return dP/dF (n, d, d, d, d), from the law and by central differences."""
        d = self.dim
        A = ufl.diff(self.P, self.F)
        A = PointExpression(ufl.as_vector([A[i] for i in np.ndindex(d, d, d, d)]), self.points)
        found, differences = self.evaluate(A, F, state).reshape(-1, d, d, d, d), []
        for step in h * np.eye(d * d).reshape(d * d, d, d):
            up, down = (self.evaluate(self.stress, F + sign * step, state) for sign in (1, -1))
            differences.append((up - down) / (2 * h))
        return found, np.stack(differences, axis=3).reshape(found.shape)


def turned(F, seed=0):
    """Return a random rotation (d, d)."""
    d = F.shape[-1]
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(d, d)))[0]
    R[0] *= np.linalg.det(R)
    return R
