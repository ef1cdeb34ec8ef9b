# SPDX-License-Identifier: MIT
"""Drucker-Prager: closed forms in principal strains, exact paths, tangent, dissipation, objectivity."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from helpers import column, set_up

import mpm_dolfinx as mpm
from mpm_dolfinx.forms.point_forms import FormPoints, PointExpression

SAND = mpm.DruckerPrager(bulk=2e7, shear=1e7, friction=30.0, dilation=10.0, cohesion=2e5, hardening=5e6)
ELASTIC, CONE, APEX = range(3)


class AtPoints:
    """The law at points, one in each cell, with arbitrary deformation gradients."""

    def __init__(self, dim):
        self.dim, cells = dim, {2: [8, 8], 3: [4, 4, 4]}[dim]
        self.grid = mpm.Grid([0] * dim, [1.0] * dim, cells)
        names = {name: () for name in SAND.parameters} | {"plastic": (3, 3), "hardened": ()}
        self.points = FormPoints(self.grid, F=(dim, dim), **names)
        self.values = {name: getattr(self.points, name) for name in names}
        self.F = ufl.variable(self.points.F)
        self.P = SAND.first_piola(self.F, self.values)
        self.stress = PointExpression(self.P, self.points)

    def place(self, F, plastic=None, hardened=None):
        n = len(F)
        data = {name: np.full(n, float(getattr(SAND, name))) for name in SAND.parameters}
        data["plastic"] = np.tile(np.eye(3), (n, 1, 1)) if plastic is None else plastic
        data["hardened"] = np.zeros(n) if hardened is None else hardened
        cells = np.arange(n, dtype=np.int32)
        return self.points.at(cells, self.grid.midpoints[cells], np.ones(n), F=F, **data)

    def kirchhoff(self, F, *state):
        """Return the in-plane Kirchhoff stress (n, d, d)."""
        return self.stress.evaluate(self.place(F, *state)) @ F.transpose(0, 2, 1)

    def update(self, F, *state):
        if not hasattr(self, "_update"):
            new = SAND.update(F=self.points.F, **self.values)
            parts = [new["plastic"][i] for i in np.ndindex(3, 3)] + [new["hardened"]]
            self._update = PointExpression(ufl.as_vector(parts), self.points)
        out = self._update.evaluate(self.place(F, *state))
        return out[:, :9].reshape(-1, 3, 3), out[:, 9]

    def tangent(self, F):
        """Return dP/dF (n, d, d, d, d), from the law and by central differences."""
        d, h = self.dim, 1e-6
        A = ufl.diff(self.P, self.F)
        A = PointExpression(ufl.as_vector([A[i] for i in np.ndindex(d, d, d, d)]), self.points)
        found, differences = A.evaluate(self.place(F)).reshape(-1, d, d, d, d), []
        for step in h * np.eye(d * d).reshape(d, d, d, d):
            for row in step:
                up, down = (self.stress.evaluate(self.place(F + sign * row)) for sign in (1, -1))
                differences.append((up - down) / (2 * h))
        return found, np.stack(differences, axis=3).reshape(found.shape)


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def law(request):
    return AtPoints(request.param)


def gradients(dim, scale=0.1, n=60):
    """Return random deformation gradients, and some with equal stretches."""
    rng = np.random.default_rng(dim)
    F = np.eye(dim) + scale * rng.normal(size=(n - 4, dim, dim))
    equal = [np.eye(dim) * a for a in (0.9, 1.0, 1.1)]
    return np.concatenate([F, equal, [np.diag([0.9] + [1.0] * (dim - 1))]])


def embedded(F):
    out = np.tile(np.eye(3), (len(F), 1, 1))
    out[:, : F.shape[1], : F.shape[1]] = F
    return out


def principal(F):
    """Return the closed form in principal strains: tau (n, 3, 3), elastic ln b (n, 3), axes, kappa and region."""
    m, out = SAND, []
    for f in embedded(F):
        w, axes = np.linalg.eigh(f @ f.T)
        e = np.log(w) / 2
        p, s = m.bulk * e.sum(), 2 * m.shear * (e - e.mean())
        q, kappa, region = np.sqrt(s @ s / 2), 0.0, ELASTIC
        outside = q + m.eta * p - m.xi * m.cohesion
        if outside > 0:
            gamma = outside / (m.shear + m.bulk * m.eta * m.eta_flow + m.xi**2 * m.hardening)
            kappa, region = m.xi * gamma, CONE
            if m.shear * gamma > q:
                region, slope = APEX, m.xi / m.eta
                volume = (p - slope * m.cohesion) / (m.bulk + slope**2 * m.hardening)
                p, s, kappa = p - m.bulk * volume, 0 * s, slope * volume
            else:
                p, s = p - m.bulk * m.eta_flow * gamma, s * (1 - m.shear * gamma / q)
        elastic = s / (2 * m.shear) + p / (3 * m.bulk)
        out.append((axes @ np.diag(p + s) @ axes.T, 2 * elastic, axes, kappa, region))
    return tuple(map(np.array, zip(*out, strict=True)))


def test_stress_and_state_are_those_of_the_return_in_principal_strains(law):
    F = gradients(law.dim)
    tau, ln_b, axes, kappa, region = principal(F)
    assert (np.bincount(region, minlength=3) > 3).all()
    assert np.abs(law.kirchhoff(F) - tau[:, : law.dim, : law.dim]).max() < 1e-9 * np.abs(tau).max()
    plastic, hardened = law.update(F)
    b = embedded(F) @ plastic @ embedded(F).transpose(0, 2, 1)
    exact = np.einsum("nij,nj,nkj->nik", axes, np.exp(ln_b), axes)
    assert np.abs(b - exact).max() < 1e-9
    assert hardened == pytest.approx(kappa, rel=1e-9, abs=1e-12)
    assert np.abs(plastic[region == ELASTIC] - np.eye(3)).max() < 1e-14


def test_the_new_state_is_on_the_yield_surface(law):
    """The stress at the end of a step equals the stress at the start of the next step, without further flow."""
    F = gradients(law.dim)
    state = law.update(F)
    assert np.abs(law.kirchhoff(F, *state) - law.kirchhoff(F)).max() < 1e-9 * SAND.shear
    assert np.abs(law.update(F, *state)[1] - state[1]).max() < 1e-9


def test_the_tangent_is_the_derivative_of_the_stress(law):
    F = gradients(law.dim)
    found, differences = law.tangent(F)
    error = np.abs(found - differences).max(axis=(1, 2, 3, 4)) / np.abs(found).max()
    region = principal(F)[-1]
    for kind in (ELASTIC, CONE, APEX):
        # F = I, with equal stretches, is tried too; only a difference across the yield surface would be void
        assert error[region == kind].max() < 1e-7


def test_plastic_flow_dissipates(law):
    """tau : (trial strain - new elastic strain) >= 0."""
    F = gradients(law.dim)
    tau, _, axes, _, region = principal(F)
    stress = np.einsum("nji,njk,nki->ni", axes, tau, axes)  # principal
    trial = np.log(np.linalg.eigvalsh(embedded(F) @ embedded(F).transpose(0, 2, 1)))
    plastic, _ = law.update(F)
    b = embedded(F) @ plastic @ embedded(F).transpose(0, 2, 1)
    elastic = np.log(np.einsum("nji,njk,nki->ni", axes, b, axes))
    dissipated = (stress * (trial - elastic) / 2).sum(axis=1)
    assert (dissipated[region != ELASTIC] > 0).all()
    assert np.abs(dissipated[region == ELASTIC]).max() < 1e-9 * dissipated.max()


def test_a_rotation_turns_the_stress_and_leaves_the_state(law):
    F, d = gradients(law.dim), law.dim
    R = np.linalg.qr(np.random.default_rng(5).normal(size=(d, d)))[0]
    R[0] *= np.linalg.det(R)
    assert np.abs(law.kirchhoff(R @ F) - R @ law.kirchhoff(F) @ R.T).max() < 1e-9 * SAND.shear
    for turned, still in zip(law.update(R @ F), law.update(F), strict=True):
        assert np.abs(turned - still).max() < 1e-10


def test_the_cone_meets_mohr_and_coulomb_where_it_says():
    c, phi = 1e4, np.radians(35)
    for match, sign in (("compression", -1), ("extension", 1)):
        m = replace(SAND, friction=35.0, cohesion=c, match=match)
        lateral = -5e4  # of two equal principal stresses; the third from (s1 - s3)/2 = c cos - (s1 + s3)/2 sin
        k = (1 + np.sin(phi)) / (1 - np.sin(phi))
        drop = 2 * c * np.sqrt(k)
        axial = k * lateral - drop if match == "compression" else (lateral + drop) / k
        p, q = (axial + 2 * lateral) / 3, sign * (axial - lateral) / np.sqrt(3)
        assert q + m.eta * p == pytest.approx(m.xi * c, abs=1e-9 * c)
    # associated flow without strain out of plane: the intermediate stress follows, and s1, s3 are Mohr-Coulomb's
    m = replace(SAND, friction=35.0, match="plane strain")
    t = -2 / 3 * m.eta  # s_zz over sqrt(J_2), from d f / d tau_zz = 0
    r = np.sqrt(1 - 3 / 4 * t**2)  # (s1 - s3) / 2 over sqrt(J_2)
    q = 3e4  # sqrt(J_2) on f = 0, s1 and s3 are p - s_zz / 2 +- r
    p = (m.xi * c - q) / m.eta
    s1, s3 = p + (r - t / 2) * q, p - (r + t / 2) * q
    assert (s1 - s3) / 2 == pytest.approx(c * np.cos(phi) - (s1 + s3) / 2 * np.sin(phi), rel=1e-12)


def oedometric(m, strain):
    """Return the exact axial and lateral Kirchhoff stress and kappa under a logarithmic compression (n,) < 0."""
    p, q = m.bulk * strain, 2 * m.shear * -strain / np.sqrt(3)
    gamma = np.maximum(0, q + m.eta * p - m.xi * m.cohesion)
    gamma /= m.shear + m.bulk * m.eta * m.eta_flow + m.xi**2 * m.hardening
    p, q = p - m.bulk * m.eta_flow * gamma, q - m.shear * gamma
    return p - 2 * q / np.sqrt(3), p + q / np.sqrt(3), m.xi * gamma


@pytest.mark.parametrize("dilation", [0.0, 10.0, 30.0])
@pytest.mark.parametrize("hardening", [0.0, 5e6])
def test_a_column_in_an_oedometer_follows_the_exact_path(dilation, hardening):
    """Stress at yield and plastic slope. The out-of-plane strain is zero, but its plastic part is not."""
    m = replace(SAND, cohesion=2e4, dilation=dilation, hardening=hardening)
    strain = lambda t: np.array(-0.05 * t)  # noqa: E731
    load = lambda t: (0, oedometric(m, strain(t))[0] / np.exp(strain(t)))  # noqa: E731
    s = column(cells=4, fluid=False, material=m, conditions=[mpm.Traction("top", load)])
    yielded = []

    def compare(s):
        axial, lateral, kappa = oedometric(m, strain(s.t))
        stress = s.effective_stress() * s.points.J[:, None, None]
        assert np.log(s.points.F[:, 1, 1]) == pytest.approx(float(strain(s.t)), abs=1e-7)
        assert stress[:, 1, 1] == pytest.approx(float(axial), rel=1e-6)
        assert stress[:, 0, 0] == pytest.approx(float(lateral), rel=1e-6)
        assert s.points.data["hardened"] == pytest.approx(float(kappa), abs=1e-6)
        yielded.append(kappa > 0)

    result = s.run(1.0, 0.05, observe=compare)
    assert 1 < sum(yielded) < len(yielded) and result.cuts == 0
    Cp_inv = s.points.data["plastic"]
    assert np.abs(np.linalg.det(Cp_inv) - 1).max() < 1e-7 if dilation == 0 else (np.linalg.det(Cp_inv) < 1 - 1e-4).all()


def assembled(simulation):
    """Return the products of the tangent, and of central differences, with a random direction."""
    momentum, rng = set_up(simulation, 1.0).momentum, np.random.default_rng(1)
    unknowns, nodal = momentum.system.unknowns, momentum.forms.u.x.array
    u, w = 5e-3 * np.random.default_rng(0).normal(size=unknowns.size), rng.normal(size=unknowns.size)
    residuals = []
    for step in (1e-7, -1e-7):
        nodal[unknowns.owned] = u + step * w
        residuals.append(momentum.assemble_residual()[0].array.copy())
    nodal[unknowns.owned] = u
    momentum.assemble_residual()
    K = momentum.assemble_tangent()
    x = unknowns.vector()
    x.array[:] = w
    return K, (K * x).array, (residuals[0] - residuals[1]) / 2e-7


@pytest.mark.parametrize("dilation", [10.0, 30.0], ids=["not associated", "associated"])
def test_the_assembled_tangent_is_the_derivative_of_the_residual(dilation):
    s = column(cells=4, width=3, offset=0.4, fluid=False, material=replace(SAND, cohesion=2e4, dilation=dilation))
    K, found, differences = assembled(s)
    assert np.abs(found - differences).max() < 1e-6 * np.abs(found).max()
    assert K.isSymmetric(1e-9 * K.norm()) == (dilation == 30.0)


def test_without_flow_the_law_is_hencky():
    positions = []
    for m in (replace(SAND, cohesion=1e12), mpm.Hencky(bulk=2e7, shear=1e7)):
        s = column(fluid=False, material=m, conditions=[mpm.Traction("top", lambda t: (0, -1e6 * t))])
        s.run(1.0, 0.5)
        positions.append(s.points.x)
    assert np.abs(positions[0] - positions[1]).max() < 1e-8


@pytest.mark.parametrize("dilation", [10.0, 30.0], ids=["not associated", "associated"])
def test_a_drained_column_ends_where_the_dry_one_does(dilation):
    """The coupled problem with an unsymmetric tangent: consolidation of a yielding column."""
    m = replace(SAND, cohesion=2e4, dilation=dilation, conductivity=1e-2)
    load = mpm.Traction("top", lambda t: (0, -8e5 * min(1, t)))
    dry = column(cells=4, fluid=False, material=m, conditions=[load])
    dry.run(1.0, 0.1)
    wet = column(cells=4, fluid=True, material=m, conditions=[load, mpm.Drained("top")])
    result = wet.run(3.0, 0.1)
    assert wet.scene.scheme.coupling == ("schur-cg" if dilation == 30.0 else "schur-fgmres")
    assert result.balance < 1e-8 and wet.points.data["hardened"].min() > 1e-3
    assert wet.points.x == pytest.approx(dry.points.x, abs=1e-5)


def triaxial(m, axial, lateral):
    """Return the exact axial and lateral stretch and kappa in triaxial compression, from the Kirchhoff stresses."""
    s, p = (lateral - axial) / np.sqrt(3), (2 * lateral + axial) / 3
    kappa = max(0.0, s + m.eta * p - m.xi * m.cohesion) / (m.xi * m.hardening)
    strain = [
        part * (axial - lateral) / (2 * m.shear) + p / (3 * m.bulk) + kappa / m.xi * (direction + m.eta_flow / 3)
        for part, direction in ((2 / 3, -1 / np.sqrt(3)), (-1 / 3, 0.5 / np.sqrt(3)))
    ]
    return *np.exp(strain), kappa


@pytest.mark.slow
def test_drained_triaxial_compression_follows_the_exact_path():
    """A cube in 3D is confined to 100 kPa, then loaded axially: stress at yield, plastic slope, lateral strain."""
    m = replace(SAND, cohesion=2e4, match="compression")

    def stress(t):
        return -1e5 * min(1, 5 * t) - 5e5 * max(0, t - 0.2) / 0.8, -1e5 * min(1, 5 * t)

    def load(axis):
        def at(t):
            axial, lateral = stress(t)
            along, across, _ = triaxial(m, axial, lateral)
            return np.eye(3)[axis] * (axial / along if axis == 2 else lateral / across)

        return at

    grid = mpm.Grid([0] * 3, [2.0] * 3, [2] * 3)
    body = mpm.box(grid, [0] * 3, [1] * 3)
    loads = [mpm.Traction(side, load(axis)) for axis, side in enumerate(("right", "back", "top"))]
    s = mpm.Simulation(grid, [body], [m], walls={"left": "x", "front": "y", "bottom": "z"}, conditions=loads)
    kappas = []

    def compare(s):
        along, across, kappa = triaxial(m, *stress(s.t))
        assert s.points.F[:, 2, 2].mean() == pytest.approx(along, abs=1e-6)
        assert s.points.F[:, 0, 0].mean() == pytest.approx(across, abs=1e-6)
        assert s.points.data["hardened"].mean() == pytest.approx(kappa, abs=2e-6)
        kappas.append(kappa)

    s.run(1.0, 0.1, observe=compare)
    assert kappas[4] == 0 and kappas[-1] > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "factor"), [(0.0, 2 + np.pi), (20.0, 14.83)])
def test_a_strip_footing_sinks_at_prandtls_load(friction, factor):
    """Bearing capacity divided by the cohesion, with associated flow: the load has an upper bound and a plateau,
    without locking.
    """
    clay = mpm.DruckerPrager(bulk=2e7, shear=1e7, friction=friction, dilation=friction, cohesion=1e4)
    grid = mpm.Grid([0, 0], [5.0, 3.5], [40, 28])
    soil = mpm.box(grid, [0, 0], [5, 3])
    footing = mpm.Displacement("top", lambda t, X: (0, -0.04 * t), region=((0, 0), (1, 9)))  # rough, half of it
    walls = {"left": "x", "right": "x", "bottom": "xy"}
    s = mpm.Simulation(grid, [soil], [clay], walls=walls, conditions=[footing])
    loads = []
    s.run(1.0, 0.1, observe=lambda s: loads.append(-s.reactions.array[0, 1] / clay.cohesion))
    assert factor < loads[-1] < 1.12 * factor
    assert abs(loads[-1] / loads[-3] - 1) < 0.02


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"friction": 90.0}, r"friction = 90.0, must be in \[0, 90\) degrees"),
        ({"dilation": 31.0}, r"dilation = 31.0, must be in \[0, friction\]"),
        ({"cohesion": -1.0}, "cohesion = -1.0, must be >= 0"),
        ({"match": "inner"}, "match = 'inner', must be one of plane strain, compression, extension"),
        ({"cohesion": lambda X: -X[:, 0]}, r"cohesion = -0\.\d+, must be >= 0"),
    ],
)
def test_constants_out_of_range_are_refused(constants, message):
    with pytest.raises(ValueError, match=message):
        column(fluid=False, material=replace(SAND, **constants))
