# SPDX-License-Identifier: MIT
"""Mohr and Coulomb's elastoplasticity at finite strain, with edges, apex and a tension cut-off.

Plasticity is multiplicative, in principal logarithmic strains, with Hencky's elasticity.  The principal Kirchhoff
stresses are t_1 >= t_2 >= t_3, tension positive.  These stresses satisfy

    f_ij = (1 + sin phi) t_i - (1 - sin phi) t_j - 2 c cos phi <= 0  for all i, j,    t_i <= T,

with the friction angle phi, the cohesion c and the tensile strength T.  The direction of flow is
(1 + sin psi) e_i - (1 - sin psi) e_j on a face f_ij, and e_i at the cut-off T.  Here psi is the dilation angle, and
e_i are the principal directions.

The final stress lies on one of ten faces, edges and vertices of the yield surface.  On each face, edge and vertex, the
final stress is linear in the trial stress (de Souza Neto, Peric and Owen 2008, 8.2, without the cut-off).  Three
conditions hold: the final stress is admissible, its principal stresses keep the order of the trial stresses, and
plastic multipliers are >= 0.  The return mapping chooses the face, edge or vertex whose stress violates these
conditions least.  Derivatives of the stress are exact, also for equal eigenvalues.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import EPSILON, NEAR
from mpm_dolfinx.forms.axes import embedded, planar
from mpm_dolfinx.materials.frictional import Frictional
from mpm_dolfinx.materials.skeleton import Field, _check
from mpm_dolfinx.materials.trial import PLANE, Coaxial, Isotropic, components, eigen, symmetric

FACE, EDGES, ALL = slice(0, 1), slice(1, 3), slice(None)  # entries of `_Return._faces`: main face, its edges, and all
NEVER = 1e6  # largest tensile strength, divided by the bulk modulus


@dataclass(frozen=True, kw_only=True)
class MohrCoulomb(Frictional):
    """Perfectly plastic law with Hencky elasticity, and with Mohr and Coulomb's yield surface in Kirchhoff stress.

    Parameters
    ----------
    friction
        Friction angle phi, degrees, in [0, 90).  At 0 the law is Tresca's law with the undrained strength `cohesion`.
    dilation
        Dilation angle psi, degrees, in [0, friction].  If psi = phi, flow is associated and the tangent is symmetric.
        Soil in tension at the apex dilates for any psi.
    cohesion
        Cohesion c, Pa, >= 0.  If c is zero, soil without mean stress has no stiffness.
    tension
        Tensile strength T, Pa, >= 0: upper limit of the principal stresses, by default the apex stress c cot phi.

    Other parameters: see `Skeleton`.  All parameters are passed by name.  The state variable in `points.data` is
    `plastic`, the inverse plastic metric C_p^-1 (3, 3).

    Raises
    ------
    ValueError
        A constant is out of its range or missing.  Friction, dilation and cohesion have no default values.
    """

    tension: Field = np.inf

    elastic_hencky: ClassVar = True
    state: ClassVar = {"plastic": np.eye(3)}
    unknowns: ClassVar = {"stress": np.zeros(6), "flows": 0.0}

    def __post_init__(self):
        super().__post_init__()
        _check(self, "tension", lambda v: 0 <= v, ">= 0")

    @property
    def sine(self):
        """Sine of the friction angle."""
        return np.sin(np.radians(self.friction))

    @property
    def sine_flow(self):
        """Sine of the dilation angle."""
        return np.sin(np.radians(self.dilation))

    @property
    def strength(self):
        """Constant 2 c cos phi of the yield functions, Pa."""
        return 2 * self.cohesion * np.cos(np.radians(self.friction))

    @property
    def cutoff(self):
        """Tensile strength, Pa, limited to a finite multiple of the bulk modulus."""
        return np.minimum(self.tension, NEVER * self.bulk)

    @staticmethod
    def trial(F, plastic):
        """Return the components of the trial elastic tensor b = F C_p^-1 F^T."""
        F3 = embedded(F)
        b, plane = F3 * plastic * F3.T, planar(F)
        return {"b": components(b, plane), "F": (F3, plane)}

    @staticmethod
    def solution(trial, bulk, shear, sine, sine_flow, strength, cutoff):
        """Return the final stress, in Pa, its derivatives with respect to b, and whether flow is plastic (1 or 0)."""
        x, axes = eigen(trial["b"])
        with np.errstate(invalid="ignore", divide="ignore"):  # in a diverging iterate, which is rejected later
            e = np.log(x) / 2
        order = np.argsort(-e, axis=1, kind="stable")
        undo, n = np.argsort(order, axis=1), np.arange(len(order))[:, None, None]
        ordered = np.take_along_axis(e, order, axis=1)
        stresses, slopes, flows = _returned(ordered, bulk, shear, sine, sine_flow, strength, cutoff)
        stresses, slopes = np.take_along_axis(stresses, undo, axis=1), slopes[n, undo[:, :, None], undo[:, None, :]]
        tensor = Coaxial(x, axes, stresses, plane=trial["b"].shape[1] == len(PLANE))
        by_b = {"b": lambda: tensor.tangent(slopes / (2 * x[:, None, :]))}
        return {"stress": (tensor.values, by_b), "flows": (flows, {})}

    @staticmethod
    def kirchhoff(stress):
        """Return the Kirchhoff stress (3, 3), in Pa, as UFL."""
        return symmetric(stress)

    @staticmethod
    def update(trial, bulk, shear, plastic, stress, flows):
        """Return the state at the end of the step as UFL, by name."""
        (F, plane) = trial["F"]
        tau = symmetric(stress)
        I = ufl.Identity(3)
        mean = ufl.tr(tau) / 3
        twice_strain = (tau - mean * I) / shear + 2 * mean / (3 * bulk) * I
        b, F_inverse = Isotropic(twice_strain, plane)(ufl.exp), ufl.inv(F)
        return {"plastic": ufl.conditional(ufl.gt(flows, 0.5), F_inverse * b * F_inverse.T, plastic)}


def _returned(e: NDArray, bulk: NDArray, shear: NDArray, sine: NDArray, sine_flow: NDArray, *limits: NDArray) -> tuple:
    """Return principal stresses, their derivatives with respect to e, and whether flow is plastic (1 or 0).

    `e` (n, 3): principal trial strains, in descending order.
    """
    elastic = (bulk - 2 * shear / 3)[:, None, None] * np.ones((3, 3)) + 2 * shear[:, None, None] * np.eye(3)
    t, slopes = np.einsum("nij,nj->ni", elastic, e), elastic
    flows = _Surface(sine, *limits).outside(t) > 0
    if flows.any():
        parameters = elastic, bulk, shear, sine, sine_flow, *limits

        trial, rows = t.copy(), np.flatnonzero(flows)
        for few in (FACE, EDGES, ALL):  # most stresses return to the main face, most others to an edge
            at = _Return(trial[rows], *(v[rows] for v in parameters))
            ends, of_trial, violation = at.end(few)
            accepted = violation <= NEAR**2 * shear[rows] if few is not ALL else slice(None)
            t[rows[accepted]], slopes[rows[accepted]] = ends[accepted], of_trial[accepted] @ elastic[rows[accepted]]
            rows = np.delete(rows, accepted)
            if not len(rows):
                break
    return t, slopes, flows.astype(float)


class _Surface:
    """The yield surface in the space of ordered principal stresses."""

    def __init__(self, sine: NDArray, strength: NDArray, cutoff: NDArray):
        self.p = 1 + sine
        self.q = 1 - sine
        self.k = strength
        self.T = cutoff

    def outside(self, t: NDArray) -> NDArray:
        """Return the largest of all yield functions at principal stresses t (n, 3); > 0 means outside the surface."""
        return np.maximum(self.p * t[:, 0] - self.q * t[:, 2] - self.k, t[:, 0] - self.T)


class _Return:
    """The return mapping of ordered principal trial stresses that are outside the yield surface."""

    def __init__(self, t, elastic, bulk, shear, sine, sine_flow, strength, cutoff):
        self._trial = t
        self._elastic = elastic
        self._K = bulk
        self._G = shear
        self._surface = s = _Surface(sine, strength, cutoff)
        self._p, self._q = 1 + sine_flow, 1 - sine_flow
        zero, one = np.zeros_like(sine), np.ones_like(sine)
        # faces: normal (n, 3), limit (n,), direction of flow (n, 3)
        main = _rows(s.p, zero, -s.q), s.k, _rows(self._p, zero, -self._q)
        right = _rows(s.p, -s.q, zero), s.k, _rows(self._p, -self._q, zero)
        left = _rows(zero, s.p, -s.q), s.k, _rows(zero, self._p, -self._q)
        first, second = ((axis, s.T, axis) for axis in (_rows(one, zero, zero), _rows(zero, one, zero)))
        self._faces = ([main], [main, left], [main, right], [first], [first, second], [main, first])
        apex, lowest = s.k / (2 * sine + EPSILON), (s.p * s.T - s.k) / s.q
        self._vertices = (
            (_rows(apex, apex, apex), self._in_apex),
            (_rows(s.T, s.T, s.T), lambda x: x.T),
            (_rows(s.T, lowest, lowest), self._in_triaxial),
            (_rows(s.T, s.T, lowest), self._in_extension),
        )

    def end(self, few: slice) -> tuple[NDArray, NDArray, NDArray]:
        """Return final stresses, their derivatives with respect to trial stresses, and their `_violation`, in Pa.

        `few`: the faces and edges of the yield surface that are tried.  `ALL` also includes the vertices.
        """
        with np.errstate(all="ignore"):  # vertices at infinity
            ends = [self._on(faces) for faces in self._faces[few]]
            if few is ALL:
                ends += [self._at(*vertex) for vertex in self._vertices]
        if len(ends) == 1:
            return ends[0]
        violation = np.array([np.nan_to_num(violations, nan=np.inf) for _, _, violations in ends])
        best, n = violation.argmin(axis=0), np.arange(len(self._trial))
        stresses, slopes = (np.array([end[i] for end in ends])[best, n] for i in (0, 1))
        return stresses, slopes, violation[best, n]

    def _violation(self, t: NDArray, multipliers: Sequence[NDArray]) -> NDArray:
        """Return how far, in Pa, a stress t violates the conditions for a final stress."""
        multipliers = [-2 * self._G * m for m in multipliers]
        return np.max([self._surface.outside(t), t[:, 1] - t[:, 0], t[:, 2] - t[:, 1], *multipliers], axis=0)

    def _on(self, faces: Sequence) -> tuple[NDArray, NDArray, NDArray]:
        """Return the results of `end` on a face, or on the edge of two faces."""
        normals, limits, flows = (np.stack(part, axis=1) for part in zip(*faces, strict=True))
        drops = np.einsum("nij,nfj->nif", self._elastic, flows)
        gram = normals @ drops
        inverse = 1 / gram if len(faces) == 1 else _inverse(gram)
        slopes = np.eye(3) - drops @ inverse @ normals
        excess = np.einsum("nfi,ni->nf", normals, self._trial) - limits
        multipliers = np.einsum("nfg,ng->nf", inverse, excess)
        t = self._trial - np.einsum("nif,nf->ni", drops, multipliers)
        return t, slopes, self._violation(t, multipliers.T)

    def _at(self, t: NDArray, conditions: Callable) -> tuple[NDArray, NDArray, NDArray]:
        """Return the results of `end` for a vertex with the principal stresses t."""
        drop = self._trial - t
        mean = drop.mean(axis=1)
        plastic = drop / (2 * self._G)[:, None] + (mean / (3 * self._K) - mean / (2 * self._G))[:, None]
        return t, np.zeros((len(t), 3, 3)), self._violation(t, conditions(plastic))

    def _in_apex(self, x: NDArray) -> list[NDArray]:
        """Return three numbers, which are all >= 0 if the apex is the final stress."""
        total, difference = x.sum(axis=1), self._p - self._q
        return [total, self._q * total + difference * x[:, 2], self._q * total + difference * (x[:, 1] + x[:, 2])]

    def _in_triaxial(self, x: NDArray) -> list[NDArray]:
        """Return numbers, which are all >= 0 if the final stress is the vertex t_1 = T, t_2 = t_3."""
        return [-x[:, 1], -x[:, 2], x[:, 0] + self._p / self._q * (x[:, 1] + x[:, 2])]

    def _in_extension(self, x: NDArray) -> list[NDArray]:
        """Return numbers, which are all >= 0 if the final stress is the vertex t_1 = t_2 = T."""
        return [x[:, 0], x[:, 1], -x[:, 2], x[:, 0] + x[:, 1] + self._p / self._q * x[:, 2]]


def _inverse(A: NDArray) -> NDArray:
    """Return the inverses of matrices (n, 2, 2)."""
    adjugate = A[:, ::-1, ::-1].transpose(0, 2, 1) * [[1, -1], [-1, 1]]
    return adjugate / (A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])[:, None, None]


def _rows(*columns: NDArray) -> NDArray:
    return np.stack(columns, axis=1)
