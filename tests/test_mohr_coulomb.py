# SPDX-License-Identifier: MIT
"""Mohr and Coulomb's law: return mapping compared with all sets of active faces, tangent, objectivity, strengths."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from helpers import column
from laws import LawAtPoints, turned

import mpm_dolfinx as mpm
from mpm_dolfinx import element_test
from mpm_dolfinx.materials.mohr_coulomb import _returned

SAND = mpm.MohrCoulomb(bulk=2e7, shear=1e7, friction=30.0, dilation=10.0, cohesion=2e5)
BRITTLE = replace(SAND, tension=1e5)


def by_all_sets(e, m):
    """Return the principal stresses (n, 3), in Pa, of trial strains in any order.

    The result is that of the admissible set of active faces with multipliers >= 0. Without dilation, soil in tension
    may have no such set; its stress is then at the apex.
    """
    D = (m.bulk - 2 * m.shear / 3) * np.ones((3, 3)) + 2 * m.shear * np.eye(3)
    p, q, a, b = 1 + m.sine, 1 - m.sine, 1 + m.sine_flow, 1 - m.sine_flow
    axes = np.eye(3)
    faces = [(p * i - q * j, m.strength, a * i - b * j) for i, j in permutations(axes, 2)]
    faces += [(i, m.cutoff, i) for i in axes]
    N, k, M = (np.array(part) for part in zip(*faces, strict=True))
    trial = e @ D
    best, least = trial.copy(), (trial @ N.T - k).max(axis=1)
    for some in (list(s) for size in (1, 2, 3) for s in combinations(range(9), size)):
        drops = D @ M[some].T
        gram = N[some] @ drops
        if abs(np.linalg.det(gram)) < 1e-8 * np.linalg.norm(gram) ** len(some):
            continue
        multipliers = (trial @ N[some].T - k[some]) @ np.linalg.inv(gram).T
        t = trial - multipliers @ drops.T
        offends = np.maximum((t @ N.T - k).max(axis=1), -2 * m.shear * multipliers.min(axis=1))
        better = (offends < least) & (least > 0)
        best[better], least[better] = t[better], offends[better]
    torn = least > 1e-9 * m.shear
    assert not torn.any() or (m.dilation == 0 and trial[torn].sum(axis=1).min() > 3 * m.strength / (2 * m.sine))
    best[torn] = m.strength / (2 * m.sine) if torn.any() else 0.0
    return best


def trials(n, seed=0):
    """Return ordered trial strains (n, 3) that end in all regions, a third of them with two or three equal values."""
    rng = np.random.default_rng(seed)
    e = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-2.5, -0.5, size=(n, 1)) + 0.02 * rng.normal(size=(n, 1))
    e[: n // 8, 1] = e[: n // 8, 0]
    e[n // 8 : n // 4, 2] = e[n // 8 : n // 4, 1]
    e[n // 4 : n // 3] = e[n // 4 : n // 3, :1]
    return -np.sort(-e, axis=1)


@pytest.mark.parametrize(
    "change",
    [{}, {"dilation": 0.0}, {"dilation": 30.0}, {"friction": 0.0, "dilation": 0.0}, {"tension": 1e5}, {"tension": 0.0},
     {"tension": 1e5, "dilation": 30.0}, {"friction": 45.0, "dilation": 20.0, "cohesion": 0.0}],
    ids=str,
)  # fmt: skip
def test_the_return_is_that_of_all_sets_of_active_faces(change):
    m, e = replace(SAND, **change), trials(12_500)
    full = [np.full(len(e), float(v)) for v in (m.bulk, m.shear, m.sine, m.sine_flow, m.strength, m.cutoff)]
    found, slopes, _ = _returned(e, *full)
    exact = by_all_sets(e, m)
    size = np.maximum(np.abs(exact).max(axis=1), 1e-3 * m.shear)
    assert (np.abs(found - exact).max(axis=1) / size).max() < 1e-9
    # derivatives, where no difference crosses from one face to another
    h = 1e-7
    steps = [(_returned(e + h * axis, *full)[1], _returned(e - h * axis, *full)[1]) for axis in np.eye(3)]
    inside = np.all([(a == slopes).all(axis=(1, 2)) & (b == slopes).all(axis=(1, 2)) for a, b in steps], axis=0)
    differences = [
        (_returned(e + h * axis, *full)[0] - _returned(e - h * axis, *full)[0]) / (2 * h) for axis in np.eye(3)
    ]
    error = np.abs(np.stack(differences, axis=2) - slopes)[inside].max() / m.bulk
    assert inside.mean() > 0.5 and error < 1e-7


@pytest.fixture(
    scope="module", params=[(2, SAND), (3, SAND), (2, BRITTLE), (3, BRITTLE)], ids=lambda p: f"{p[0]}D {p[1].tension}"
)
def law(request):
    return LawAtPoints(request.param[1], request.param[0])


def gradients(dim, scale=0.1, n=60):
    """Return random deformation gradients, and some with equal stretches."""
    rng = np.random.default_rng(dim)
    F = np.eye(dim) + scale * rng.normal(size=(n - 5, dim, dim))
    diagonal = [[0.9] * dim, [1.0] * dim, [1.1] * dim, [0.9] + [1.0] * (dim - 1), [1.0] + [0.8] * (dim - 1)]
    return np.concatenate([F, [np.diag(d) for d in diagonal]])


def full(F):
    out = np.tile(np.eye(3), (len(F), 1, 1))
    out[:, : F.shape[1], : F.shape[1]] = F
    return out


def test_stress_and_state_are_those_of_the_return_in_principal_strains(law):
    F, m = gradients(law.dim), law.material
    w, axes = np.linalg.eigh(full(F) @ full(F).transpose(0, 2, 1))
    stresses = by_all_sets(np.log(w) / 2, m)
    tau = np.einsum("nij,nj,nkj->nik", axes, stresses, axes)[:, : law.dim, : law.dim]
    assert np.abs(law.kirchhoff(F) - tau).max() < 1e-8 * np.abs(tau).max()
    mean = stresses.mean(axis=1, keepdims=True)
    elastic = (stresses - mean) / (2 * m.shear) + mean / (3 * m.bulk)
    b = full(F) @ law.update(F)["plastic"] @ full(F).transpose(0, 2, 1)
    assert np.abs(b - np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * elastic), axes)).max() < 1e-8
    again = law.kirchhoff(F, law.update(F))  # the end of a step is on the surface, and stays there
    assert np.abs(again - law.kirchhoff(F)).max() < 1e-8 * m.shear


def test_the_tangent_is_the_derivative_of_the_stress(law):
    F = gradients(law.dim)
    found, differences = law.tangent(F)
    error = np.abs(found - differences).max(axis=(1, 2, 3, 4)) / np.abs(found).max()
    assert error.max() < 1e-8


def test_a_rotation_turns_the_stress_and_leaves_the_state(law):
    F = gradients(law.dim)
    R = turned(F)
    assert np.abs(law.kirchhoff(R @ F) - R @ law.kirchhoff(F) @ R.T).max() < 1e-8 * law.material.shear
    assert np.abs(law.update(R @ F)["plastic"] - law.update(F)["plastic"]).max() < 1e-8


def test_triaxial_strengths_are_those_of_mohrs_circles():
    """Compression and extension, in Kirchhoff stresses: (t1 - t3)/2 = c cos phi - (t1 + t3)/2 sin phi."""
    for strain in (0.1, -0.1):
        r = element_test(replace(SAND, cohesion=1e4), "triaxial drained", strain, steps=10, confinement=1e5)
        tau = np.sort(np.diag(r.stress[-1])) * np.linalg.det(r.F[-1])
        radius, middle = (tau[2] - tau[0]) / 2, (tau[2] + tau[0]) / 2
        assert radius == pytest.approx(1e4 * np.cos(np.radians(30)) - middle * 0.5, rel=1e-9)
    dilates = np.diff(r.volume_strain[-3:]) / np.diff(r.strain[-3:])  # extension: of the strain away from the axis
    assert np.all(np.abs(dilates) > 0.1)


def test_without_friction_it_is_trescas_law():
    clay = replace(SAND, friction=0.0, dilation=0.0, cohesion=1e4)
    for kind in ("triaxial undrained", "shear undrained"):
        r = element_test(clay, kind, 0.05, steps=10)
        principal = np.linalg.eigvalsh(r.stress[-1])
        assert principal[2] - principal[0] == pytest.approx(2e4, rel=1e-9)


def test_no_stress_is_above_the_tensile_strength():
    r = element_test(replace(BRITTLE, tension=1e3), "oedometer", -0.05, steps=10)
    tau = np.linalg.eigvalsh(r.stress[-1]) * np.linalg.det(r.F[-1])
    assert tau.max() == pytest.approx(1e3, rel=1e-9)


@pytest.mark.parametrize("dilation", [10.0, 30.0], ids=["not associated", "associated"])
def test_a_column_in_a_scene_follows_the_element_test(dilation):
    soil = replace(SAND, cohesion=2e4, dilation=dilation)
    lab = element_test(soil, "oedometer", 0.05, steps=10)
    load = lambda t: (0, np.interp(t, lab.strain / 0.05, lab.stress[:, 2, 2]))  # noqa: E731
    s = column(cells=4, fluid=False, material=soil, conditions=[mpm.Traction("top", load)])
    result = s.run(1.0, 0.1)
    assert result.cuts == 0 and s.scene.momentum.symmetric == (dilation == 30.0)
    assert np.log(s.points.F[:, 1, 1]) == pytest.approx(-0.05, rel=1e-6)
    assert s.effective_stress()[:, 0, 0] == pytest.approx(lab.stress[-1, 0, 0], rel=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": 90.0}, r"friction = 90.0, must be in \[0, 90\) degrees"),
        ({"dilation": 31.0}, r"dilation = 31.0, must be in \[0, friction\]"),
        ({"cohesion": None}, "cohesion is not given, must be >= 0 Pa"),
        ({"tension": -1.0}, "tension = -1.0, must be >= 0"),
    ],
)
def test_one_line_says_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        replace(SAND, **change)
