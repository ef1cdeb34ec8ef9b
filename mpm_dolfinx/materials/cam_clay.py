# SPDX-License-Identifier: MIT
"""Modified Cam Clay at finite strain (Borja and Tamagnini 1998), and the Barcelona Basic Model for suction.

The law describes clay whose yield surface grows with plastic compaction.  Plasticity is multiplicative, in principal
logarithmic strains.  Let tau be the Kirchhoff stress, e_v the elastic volume strain, and e the elastic deviatoric
strain (tension positive).  With P = -tr(tau)/3 and Q = sqrt(3/2) norm(dev tau), the law is

    P = P_0 exp(-e_v / kappa),   dev tau = 2G e,
    f = Q^2 / M^2 + P (P - P_c) <= 0,   dP_c / P_c = -de_v^p / (lambda - kappa),

with associated flow.  P_0 is the pressure at F = I, G is the shear modulus, M is the slope of the critical state line,
P_c is the size of the yield surface, and e_v^p is the plastic volume strain.  The logarithm of the specific volume is
linear in ln P (bilogarithmic law), with the slope lambda in first loading and the slope kappa in unloading.

A step starts from the trial stresses P_t and Q_t, and from the size P_c,n of the yield surface.  The two unknowns are
the plastic compaction divided by kappa, called `a`, and the plastic multiplier dgamma.  With
6G dgamma / M^2 = exp(h) - 1 and w = (Q_t / (M P_t))^2, the stress at the end of the step is given by

    P = P_t exp(-a),   Q = Q_t exp(-h),   P_c = P_c,n exp(rho a),   rho = kappa / (lambda - kappa),
    (6G kappa / M^2) a = (exp(h) - 1) (2P - P_c).

The local unknown d = 2 (h - a) determines the stress ratio at the end of the step, Q / (M P) = sqrt(w) exp(-d/2).  On
the yield surface a = (ln(P_t / P_c,n) + ln(1 + w exp(-d))) / (1 + rho).  The equation for d is smooth and monotone,
also at isotropic stress and at the critical state, where a = 0.

If M^2 P_c > 6G (lambda - kappa), soil on the dry side of the critical state softens faster than it unloads elastically.
Then either the stress jumps, or the equation for d has no solution and the time step is reduced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from inspect import Parameter, Signature
from typing import ClassVar

import numpy as np
import ufl
from numpy.typing import NDArray

from mpm_dolfinx.base.tolerances import SAME
from mpm_dolfinx.base.validation import line
from mpm_dolfinx.materials.skeleton import DRIED, Field, Skeleton, _check, check_given
from mpm_dolfinx.materials.trial import Trial

GIVEN = {
    "M": "> 0",
    "lambda_": "> kappa",
    "kappa": "> 0",
    "initial_stress": "three normal effective stresses whose mean is compressive, < 0 Pa",
}
"""Required constants and their ranges."""


class _Follows(float):
    """Initial bulk modulus P_0 / kappa, computed from the other constants of the clay."""

    follows = True


@dataclass(frozen=True)
class _FollowsByPlace:
    """Initial bulk modulus P_0 / kappa as a function of position."""

    stress: object
    kappa: object
    follows: ClassVar[bool] = True

    def __call__(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the initial bulk moduli, in Pa, at reference positions X (n, d), in m."""
        at = [f(X) if callable(f) else np.asarray(f) for f in (self.stress, self.kappa)]
        return np.broadcast_to(-np.mean(at[0], axis=-1) / at[1], len(X))


@dataclass(frozen=True, kw_only=True)
class ModifiedCamClay(Skeleton):
    """Modified Cam Clay with a constant shear modulus, in Kirchhoff stress.

    Parameters
    ----------
    M
        Slope of the critical state line Q = M P, -, > 0.
    lambda_, kappa
        Slopes of ln v against ln P, -, 0 < kappa < lambda_: `lambda_` in first loading, and `kappa` in unloading.  Here
        v is the specific volume, and P is the mean Kirchhoff pressure.  If v has the slope C against the logarithm of
        the Cauchy stress, the slope of ln v against ln P is C / (v - C).
    initial_stress : (3,), Pa
        Normal effective stresses at F = I, tension positive.  Their mean must be < 0.  The last stress is out of plane
        in 2D, and circumferential in axisymmetry.  These stresses must be in equilibrium with the loads.  For bodies
        with an `initial_stress` of the scene, such as `K0`, the stress of the scene replaces these stresses.  Then all
        values with a mean < 0 give the same results.
    OCR
        Overconsolidation ratio, -, >= 1: initial size P_c of the yield surface, divided by the size of the yield
        surface that passes through the initial stress.
    shear
        Shear modulus G, Pa, > 0.
    bulk
        Must not be given: the initial bulk modulus is P_0 / kappa.

    Other parameters: see `Skeleton`.  All parameters are passed by name.  The state variable `plastic` in `points.data`
    is the inverse plastic metric C_p^-1 (3, 3).  The state variable `consolidated` is ln(P_c / initial P_c).  Source:
    Borja and Tamagnini (1998).

    Raises
    ------
    ValueError
        A constant is out of its range or missing.
    """

    bulk: Field = None
    M: Field = None
    lambda_: Field = None
    kappa: Field = None
    initial_stress: Field = None
    OCR: Field = 1.0

    state: ClassVar = {"plastic": np.eye(3), "consolidated": 0.0}
    unknowns: ClassVar = {"steeper": 0.0}

    def __post_init__(self):
        check_given(self, GIVEN)
        for name in ("M", "kappa"):
            _check(self, name, lambda v: (0 < np.asarray(v)) & np.isfinite(v), "> 0 and finite")
        if not callable(self.kappa):
            allowed = f"finite and > kappa = {np.max(self.kappa):g}"
            _check(self, "lambda_", lambda v: (np.asarray(v) > self.kappa) & np.isfinite(v), allowed)
        _check(self, "OCR", lambda v: (1 <= np.asarray(v)) & np.isfinite(v), ">= 1 and finite")
        _check(self, "initial_stress", _compressive, GIVEN["initial_stress"])
        self._set_bulk()
        super().__post_init__()

    def _set_bulk(self) -> None:
        """Set the initial bulk modulus P_0 / kappa."""
        stress, kappa = self.initial_stress, self.kappa
        if callable(stress) or callable(kappa):
            bulk = _FollowsByPlace(stress, kappa)
        else:
            bulk = -np.mean(stress, axis=-1) / kappa
            bulk = bulk if np.ndim(bulk) else _Follows(bulk)
        if self.bulk is None or getattr(self.bulk, "follows", False):  # it was derived before `replace`
            object.__setattr__(self, "bulk", bulk)
        elif callable(self.bulk) or (not callable(bulk) and not np.allclose(self.bulk, bulk, rtol=SAME)):
            raise ValueError(f"{type(self).__name__}: bulk = {line(self.bulk)}, must be left out; it is P_0 / kappa")

    @property
    def nearly_incompressible(self) -> bool:
        return True  # flow at the critical state is isochoric

    @property
    def pressure(self):
        """Pressure P_0 at F = I, Pa."""
        return -np.mean(self.initial_stress, axis=-1)

    @property
    def _deviator(self):
        return np.asarray(self.initial_stress) + np.asarray(self.pressure)[..., None]

    @property
    def prestretch(self):
        """Isochoric principal elastic stretches (3,) at F = I."""
        return np.exp(self._deviator / (2 * np.asarray(self.shear)[..., None]))

    @property
    def yield_pressure(self):
        """Size P_c of the yield surface at the start, Pa."""
        Q2 = 1.5 * (self._deviator**2).sum(axis=-1)
        return self.OCR * (self.pressure + Q2 / (self.M**2 * self.pressure))

    @staticmethod
    def trial(F, prestretch, plastic):
        """Return the trial elastic strain, its trace e_v, and the product 2/3 e : e of its deviator e."""
        strain = Trial(F, plastic, prestretch)
        e = strain.deviatoric
        return {"volume": strain.volumetric, "distortion": 2 / 3 * ufl.inner(e, e), "strain": strain}

    @staticmethod
    def residual(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper):
        """Return the residual of the equation for the local unknown d."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        c, P = 6 * shear * kappa / M**2, to.trial_pressure * ufl.exp(-to.compaction)
        rule = (c * to.compaction - (ufl.exp(to.flow) - 1) * (1 - to.steepness) * P) / (c + P)
        rule = ufl.conditional(
            ufl.lt(to.flow, -SAME), 1 / SAME, rule
        )  # with fast softening there is a second root, with negative plastic flow
        return {"steeper": ufl.conditional(to.yields, rule, steeper)}

    @staticmethod
    def kirchhoff(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper):
        """Return the Kirchhoff stress (3, 3), in Pa, as UFL."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        a, h = (ufl.conditional(to.yields, value, 0.0) for value in (to.compaction, to.flow))
        deviator = 2 * shear * ufl.exp(-h) * trial["strain"].deviatoric
        return deviator - to.trial_pressure * ufl.exp(-a) * ufl.Identity(3)

    @staticmethod
    def update(trial, shear, M, lambda_, kappa, pressure, yield_pressure, plastic, consolidated, steeper):
        """Return the state at the end of the step as UFL, by name."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        strain = trial["strain"]
        a = to.compaction
        ratio = ufl.exp(-to.flow)
        volume = strain.volumetric + kappa * a
        b = strain.isotropic(lambda e: ufl.exp(2 * volume / 3 + ratio * (ufl.ln(e) - 2 * strain.volumetric / 3)))
        inverse = ufl.inv(strain.F)
        return {
            "plastic": ufl.conditional(to.yields, inverse * b * inverse.T, plastic),
            "consolidated": consolidated + ufl.conditional(to.yields, to.rho * a, 0.0),
        }


LC = {"r": "> kappa / lambda_, <= 1", "beta": ">= 0 1/Pa and finite", "reference": "> 0 Pa and finite"}
"""Constants of the loading-collapse curve and their ranges."""


def _dried(function: Callable) -> Callable:
    """Return a function that calls `function`, a method of Cam Clay, with lambda and P_c at the present suction."""
    arguments = Skeleton.arguments_of(function)

    def of(**given):
        wet, kappa, consolidated = (given[name] for name in ("lambda_", "kappa", "consolidated"))

        def slope(s):
            return wet * (1 - (1 - given["r"]) * (1 - ufl.exp(-given["beta"] * s)))

        def power(s):
            return (wet - kappa) / (slope(s) - kappa)

        start = ufl.ln(given["yield_pressure"] / given["reference"])
        initial = ufl.conditional(ufl.gt(start, 0), start / power(given["suction_at_start"]), start)
        size = initial + consolidated  # ln(P_c0 / P_r)
        s = ufl.conditional(ufl.gt(size, 0), given["trial"]["suction"], 0.0)
        dried = consolidated + (power(s) - 1) * size + (initial - start)  # ln(P_c / initial P_c)
        out = function(**({name: given[name] for name in arguments} | {"lambda_": slope(s), "consolidated": dried}))
        if function is ModifiedCamClay.update:
            out["consolidated"] = consolidated + (out["consolidated"] - dried) / power(s)
        return out

    of.__signature__ = Signature([Parameter(name, Parameter.KEYWORD_ONLY) for name in (*arguments, *DRIED[1:], *LC)])
    of.__qualname__ = function.__qualname__
    return of


@dataclass(frozen=True, kw_only=True)
class BarcelonaBasic(ModifiedCamClay):
    """Modified Cam Clay with a yield surface that grows with suction, for soil that collapses on wetting.

    P_c is the size of the yield surface in Bishop's stress at the suction s = max(-p, 0), where p is the pore pressure.
    P_c0 is the size of the yield surface in saturated soil.  The loading-collapse curve of the Barcelona Basic Model is

        P_c / P_r = (P_c0 / P_r)^((lambda(0) - kappa) / (lambda(s) - kappa)),
        lambda(s) = lambda(0) [(1 - r) exp(-beta s) + r],   dP_c0 / P_c0 = -de_v^p / (lambda(0) - kappa),

    with the constants P_r, r and beta below.  At constant suction the law is Modified Cam Clay with lambda(s).  Suction
    has no effect on the yield surface if P_c0 is below P_r.  Bishop's stress alone determines the strength due
    to suction, and the swelling on wetting.  The suction is evaluated at the end of a substep.

    Parameters
    ----------
    lambda_
        Slope lambda(0) of ln v against ln P in first loading of saturated soil.
    OCR
        Overconsolidation ratio, -, >= 1: initial size P_c of the yield surface, divided by the size of the yield
        surface that passes through the initial stress.
    initial_stress : (3,), Pa
        Bishop's effective stresses at F = I.
    r
        Slope lambda of very dry soil divided by lambda(0), -, in (kappa / lambda_, 1].
    beta
        Rate of decrease of lambda with suction, 1/Pa, >= 0.
    reference
        Reference stress P_r of the loading-collapse curve, Pa, > 0, usually 0.01 to 0.5 times the initial P_c0.

    Other parameters: see `ModifiedCamClay`.  A scene with fluid requires `retention`.  State variables are `plastic`,
    `consolidated` = ln(P_c0 / initial P_c0), and `suction` and `suction_at_start`, in Pa.  Source: Alonso, Gens and
    Josa (1990); for Bishop's stress Bolzon, Schrefler and Zienkiewicz (1996).

    Raises
    ------
    ValueError
        A constant is out of its range or missing.
    """

    r: Field = None
    beta: Field = None
    reference: Field = None

    state: ClassVar = {**ModifiedCamClay.state, **dict.fromkeys(DRIED, 0.0)}

    def __post_init__(self):
        check_given(self, LC)
        super().__post_init__()
        if not (callable(self.kappa) or callable(self.lambda_)):
            least = np.asarray(self.kappa) / self.lambda_
            _check(
                self,
                "r",
                lambda v: (v > least * (1 + SAME)) & (v <= 1),
                f"> kappa / lambda_ = {np.max(least):g} and <= 1",
            )
        _check(self, "beta", lambda v: (0 <= v) & np.isfinite(v), LC["beta"])
        _check(self, "reference", lambda v: (0 < v) & np.isfinite(v), LC["reference"])

    @staticmethod
    def trial(F, prestretch, plastic, suction):
        """Return the trial values of Modified Cam Clay, and the suction."""
        return {**ModifiedCamClay.trial(F, prestretch, plastic), "suction": suction}

    residual = staticmethod(_dried(ModifiedCamClay.residual))
    kirchhoff = staticmethod(_dried(ModifiedCamClay.kirchhoff))
    update = staticmethod(_dried(ModifiedCamClay.update))


class _Return:
    """Result of the return mapping for a value of the unknown d.

    `compaction`: the unknown `a`, plastic compaction divided by kappa.
    `flow`: h = ln(Q_t / Q), which depends on dgamma.
    `steepness`: w exp(-d), the square of Q / (M P) at the end of the step.
    `trial_pressure`: P_t, in Pa.
    `rho`: kappa / (lambda - kappa).
    `yields`: whether the trial stress is outside the yield surface.
    """

    def __init__(self, trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper):
        self.rho = kappa / (lambda_ - kappa)
        self.trial_pressure = P = pressure * ufl.exp(-trial["volume"] / kappa)
        w = (3 * shear / (M * P)) ** 2 * trial["distortion"]
        over = -trial["volume"] / kappa + ufl.ln(pressure / yield_pressure) - consolidated  # ln(P_t / P_c)
        self.yields = ufl.gt(over + ufl.ln(1 + w), 0)
        self.steepness = w * ufl.exp(-steeper)
        self.compaction = (over + ufl.ln(1 + self.steepness)) / (1 + self.rho)
        self.flow = self.compaction + steeper / 2


def _compressive(stress) -> np.ndarray:
    """Return whether normal stresses (..., 3) are finite and their mean is compressive."""
    stress = np.asarray(stress, dtype=float)
    if stress.shape[-1:] != (3,):
        return np.array(False)
    return np.isfinite(stress).all(axis=-1) & (stress.mean(axis=-1) < 0)
