# SPDX-License-Identifier: MIT
"""Modified Cam Clay: closed forms of element tests, return mapping and tangent at random strains, and columns."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import column
from laws import LawAtPoints, turned

import mpm_dolfinx as mpm
from mpm_dolfinx import element_test

P0 = 1e5
CLAY = mpm.ModifiedCamClay(M=1.2, lambda_=0.0726, kappa=0.0145, shear=30 * P0, initial_stress=(-P0,) * 3, OCR=1.3)
CRITICAL = 1 - CLAY.kappa / CLAY.lambda_  # Lambda


@pytest.fixture(scope="module", params=[2, 3], ids=["2D", "3D"])
def law(request):
    return LawAtPoints(replace(CLAY, initial_stress=(-0.8 * P0, -1.2 * P0, -P0)), request.param)


def gradients(dim, scale=0.02, n=60):
    """Return deformation gradients near I, with compression on average; some have equal stretches."""
    rng = np.random.default_rng(dim)
    F = np.eye(dim) + scale * rng.normal(size=(n - 3, dim, dim))
    return np.concatenate([F, [np.eye(dim) * a for a in (0.98, 0.995, 1.005)]])


def test_a_law_keeps_its_values_if_the_script_changes_its_arrays():
    stress = np.full(3, -P0)
    clay = replace(CLAY, initial_stress=stress)
    stress *= 2
    assert list(clay.initial_stress) == [-P0] * 3


def test_isotropic_compression_follows_lambda_and_kappa():
    """ln J = -kappa ln(P / P_0) below P_c, with slope -lambda beyond P_c, and unloading along kappa."""
    r = element_test(CLAY, "isotropic", [0.04, 0.03], steps=20)
    ln_J = -3 * r.strain
    at_yield = -CLAY.kappa * np.log(CLAY.OCR)
    loading = np.where(ln_J > at_yield, -ln_J / CLAY.kappa, np.log(CLAY.OCR) - (ln_J - at_yield) / CLAY.lambda_)
    loading[21:] = loading[20] - (ln_J[21:] - ln_J[20]) / CLAY.kappa
    assert r.p * np.exp(ln_J) == pytest.approx(P0 * np.exp(loading), rel=1e-9)
    assert r.q.max() < 1e-8 * P0


@pytest.mark.parametrize("OCR", [1.0, 1.5, 8.0])
def test_undrained_triaxial_compression_ends_at_the_critical_state_of_its_volume(OCR):
    """The test ends at P_cs = P_0 (R/2)^Lambda and Q = M P. Before, Q = M sqrt(P (P_c - P)) at constant volume."""
    clay = replace(CLAY, OCR=OCR)
    r = element_test(clay, "triaxial undrained", 0.6, steps=60)
    assert r.p[-1] == pytest.approx(P0 * (OCR / 2) ** CRITICAL, rel=1e-9)
    assert r.q[-1] == pytest.approx(clay.M * r.p[-1], rel=1e-9)
    yielded = np.abs(r.state["consolidated"]) > 1e-12
    P = r.p[yielded]
    Pc = OCR * P0 * (P / P0) ** (-clay.kappa / (clay.lambda_ - clay.kappa))
    assert len(P) > 20 and r.q[yielded] == pytest.approx(clay.M * np.sqrt(P * (Pc - P)), rel=1e-9)
    assert r.pressure[-1] == pytest.approx(P0 + r.q[-1] / 3 - r.p[-1], rel=1e-9)  # of the total stress path


def test_drained_triaxial_compression_ends_where_its_path_meets_the_critical_state_line():
    r = element_test(CLAY, "triaxial drained", 1.5, steps=60)
    assert r.p[-1] == pytest.approx(3 * P0 / (3 - CLAY.M), rel=1e-6)
    assert r.q == pytest.approx(3 * (r.p - P0), abs=1e-6 * P0)


def test_without_overconsolidation_the_initial_stress_is_on_the_yield_surface():
    clay = replace(CLAY, initial_stress=(-0.5 * P0, -0.5 * P0, -P0), OCR=1.0)
    r = element_test(clay, "oedometer", [1e-4, 0.0, -1e-4], steps=1)
    assert r.stress[0] == pytest.approx(np.diag(clay.initial_stress), abs=1e-9 * P0)
    assert r.state["consolidated"][1] > 1e-5 and r.state["consolidated"][2] == r.state["consolidated"][1]


def test_the_return_is_on_the_yield_surface_by_an_associated_flow(law):
    """The new elastic strain fulfils f = 0, and the plastic strain has the direction of the gradient of f."""
    m, F = law.material, gradients(law.dim)
    state = law.update(F)
    full = np.tile(np.eye(3), (len(F), 1, 1))
    full[:, : law.dim, : law.dim] = F
    full = full * m.prestretch
    strains = []
    for plastic in (np.eye(3), state["plastic"]):
        w, axes = np.linalg.eigh(full @ plastic @ full.transpose(0, 2, 1))
        strains.append(np.einsum("nij,nj,nkj->nik", axes, np.log(w) / 2, axes))
    trial, elastic = strains
    volume = np.trace(elastic, axis1=1, axis2=2)
    P, s = m.pressure * np.exp(-volume / m.kappa), 2 * m.shear * (elastic - volume[:, None, None] / 3 * np.eye(3))
    Pc = m.yield_pressure * np.exp(state["consolidated"])
    f = 1.5 * (s * s).sum(axis=(1, 2)) / m.M**2 + P * (P - Pc)
    flow = trial - elastic
    flows = np.abs(flow).max(axis=(1, 2)) > 1e-9
    assert 10 < flows.sum() < len(F) and (f[~flows] < 0).all()
    assert np.abs(f / P**2)[flows].max() < 1e-9
    gradient = 3 / m.M**2 * s - ((2 * P - Pc) / 3)[:, None, None] * np.eye(3)
    along = (flow * gradient).sum(axis=(1, 2)) / (gradient**2).sum(axis=(1, 2))
    assert (along[flows] > 0).all()
    assert np.abs(flow - along[:, None, None] * gradient)[flows].max() < 1e-9
    # hardening: P_c follows the plastic volume strain
    hardens = -np.trace(flow, axis1=1, axis2=2) / (m.lambda_ - m.kappa)
    assert state["consolidated"] == pytest.approx(hardens, abs=1e-9)
    tau = (s - P[:, None, None] * np.eye(3))[:, : law.dim, : law.dim]
    assert np.abs(law.kirchhoff(F) - tau).max() < 1e-9 * P0 * np.abs(tau / P0).max()


def test_the_tangent_is_the_derivative_of_the_stress(law):
    F = gradients(law.dim)
    found, differences = law.tangent(F, h=3e-7)
    error = np.abs(found - differences).max(axis=(1, 2, 3, 4)) / np.abs(found).max(axis=(1, 2, 3, 4))
    assert error.max() < 1e-7


def test_a_rotation_turns_the_stress_and_leaves_the_state(law):
    F = gradients(law.dim)
    R = turned(F)
    scale = np.abs(law.kirchhoff(F)).max()
    assert np.abs(law.kirchhoff(R @ F) - R @ law.kirchhoff(F) @ R.T).max() < 1e-9 * scale
    for name, values in law.update(F).items():
        assert np.abs(law.update(R @ F)[name] - values).max() < 1e-9


def test_a_column_in_a_scene_follows_the_element_test():
    """A column is confined by its initial stress and loaded beyond yield. The law is the same on two processes."""
    clay = replace(CLAY, OCR=1.2)
    lab = element_test(clay, "oedometer", 0.02, steps=10)
    load = lambda t: (0, np.interp(t, lab.strain / 0.02, lab.stress[:, 2, 2]))  # noqa: E731
    s = column(cells=4, fluid=False, material=clay, conditions=[mpm.Traction("top", load)])
    assert s.effective_stress() == pytest.approx(-P0 * np.tile(np.eye(2), (len(s.points), 1, 1)), rel=1e-9, abs=1e-4)
    result = s.run(1.0, 0.1)
    assert result.cuts == 0
    assert np.log(s.points.F[:, 1, 1]) == pytest.approx(-0.02, rel=1e-6)
    assert s.effective_stress()[:, 0, 0] == pytest.approx(lab.stress[-1, 0, 0], rel=1e-6)
    assert s.points.data["consolidated"] == pytest.approx(lab.state["consolidated"][-1], rel=1e-6)


def test_parameters_may_differ_from_place_to_place():
    depth = lambda X: -(1 + X[:, [1]]) * P0 * np.array([1.0, 1.0, 1.0])  # noqa: E731
    clay = replace(CLAY, initial_stress=depth, OCR=lambda X: 1 + X[:, 1])
    s = column(cells=4, fluid=False, material=clay)
    mean = -np.trace(s.effective_stress(), axis1=1, axis2=2) / 2
    assert mean == pytest.approx((1 + s.points.x[:, 1]) * P0, rel=1e-9)


def test_the_bulk_modulus_follows_what_is_replaced_and_what_a_stage_changes():
    wide = replace(CLAY, lambda_=0.1, kappa=0.02)
    assert wide.bulk == pytest.approx(P0 / 0.02) and replace(wide, initial_stress=(-2 * P0,) * 3).bulk == 2 * wide.bulk
    by_place = replace(wide, kappa=lambda X: 0.02 + 0.01 * X[:, 1])
    assert replace(by_place, kappa=0.01).bulk == pytest.approx(P0 / 0.01)
    s = column(cells=4, fluid=False, material=by_place)
    s.stage(fields={"kappa": 0.04})
    assert s.points.data["bulk"] == pytest.approx(P0 / 0.04)
    with pytest.raises(ValueError, match=r"stage: fields: .* bulk = .*, must be left out"):
        s.stage(fields={"bulk": 1e9})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lambda_": 0.01}, "lambda_ = 0.01, must be finite and > kappa = 0.0145"),
        ({"M": None}, "M is not given, must be > 0"),
        ({"OCR": 0.5}, "OCR = 0.5, must be >= 1"),
        (
            {"initial_stress": (1e5, 1e5, 1e5)},
            "initial_stress = .*, must be three normal effective stresses whose mean",
        ),
        ({"initial_stress": 1e5}, "must be three normal effective stresses"),
        ({"bulk": 1e9}, "must be left out; it is P_0 / kappa"),
        ({"bulk": lambda X: np.full(len(X), 1e9)}, "must be left out; it is P_0 / kappa"),
        ({"shear": -1.0}, "shear = -1.0, must be > 0"),
    ],
)
def test_one_line_says_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        replace(CLAY, **change)
    assert "\n" not in str(caught.value)
