# SPDX-License-Identifier: MIT
"""Modified Cam Clay at finite strain (Borja and Tamagnini 1998), with one local unknown; Barcelona's with suction.

Multiplicative, in principal logarithmic strains, as Drucker and Prager's law: with the elastic volume strain e_v and
deviator e (tension positive), pressure P = -tr(tau)/3 and Q = sqrt(3/2) |dev tau| in Kirchhoff stress,

    P = P_0 exp(-e_v / kappa),   dev tau = 2G e,
    f = Q^2 / M^2 + P (P - P_c) <= 0,   dP_c / P_c = -de_v^p / (lambda - kappa),

flow associated.  P and P_c follow the bilogarithmic law: ln v is linear in ln P.  A step is implicit, from the trial
stresses P_t and Q_t, w = (Q_t / (M P_t))^2, with the plastic compaction kappa a and 6G dgamma / M^2 = exp(h) - 1:

    P = P_t exp(-a),   Q = Q_t exp(-h),   P_c = P_c,n exp(rho a),   rho = kappa / (lambda - kappa),
    (6G kappa / M^2) a = (exp(h) - 1) (2P - P_c).

The unknown is d = 2 (h - a), by which the end is steeper than the trial: Q / (M P) = sqrt(w) exp(-d/2).  It gives
a = (ln(P_t / P_c,n) + ln(1 + w exp(-d))) / (1 + rho) from the yield surface, and all is smooth and monotone, at the
critical state, where a says nothing, and at isotropic stresses too.

Where M^2 P_c > 6G (lambda - kappa) soil on the dry side softens faster than it unloads: its stress jumps, or the
step has no solution and is cut.
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
"""Constants that must be given, and what they may be."""


class _Follows(float):
    """A number that follows from other constants."""

    follows = True


@dataclass(frozen=True)
class _FollowsByPlace:
    """The same, as a function of places: P_0 / kappa of initial stresses and slopes, each a value or a function."""

    stress: object
    kappa: object
    follows: ClassVar[bool] = True

    def __call__(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the bulk moduli (m,), Pa, at places X (m, d)."""
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
        Slopes lambda* and kappa* of ln v over ln P, first loading and unloading, -, 0 < kappa < lambda_, in Kirchhoff
        stress.  An index C of v over the logarithm of the Cauchy stress, at the specific volume v, is C / (v - C) here.
    initial_stress : (3,), Pa
        Normal effective stresses at F = I, the last one out of plane in 2D, in axisymmetry along the hoops; tension
        positive, their mean < 0.  The loads have to balance them.
    OCR
        Overconsolidation ratio, -, >= 1: how much larger the yield surface is at the start than that through the
        initial stress.
    shear
        Shear modulus G, Pa, > 0.
    bulk
        Not to be given: P_0 / kappa, at the start.

    The other parameters are those of `Skeleton`, all by name.  The state is `plastic`, C_p^-1 (3, 3), and
    `consolidated`, ln of P_c over that at the start, in `points.data`.  Borja and Tamagnini (1998).

    Raises
    ------
    ValueError
        Naming the constant that is out of its range, or is not given.
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
        """Set the bulk modulus of the start, from which the scheme takes its scales."""
        stress, kappa = self.initial_stress, self.kappa
        if callable(stress) or callable(kappa):
            bulk = _FollowsByPlace(stress, kappa)
        else:
            bulk = -np.mean(stress, axis=-1) / kappa
            bulk = bulk if np.ndim(bulk) else _Follows(bulk)
        if self.bulk is None or getattr(self.bulk, "follows", False):  # of another one's constants: `replace`
            object.__setattr__(self, "bulk", bulk)
        elif callable(self.bulk) or (not callable(bulk) and not np.allclose(self.bulk, bulk, rtol=SAME)):
            raise ValueError(f"{type(self).__name__}: bulk = {line(self.bulk)}, must be left out: it is P_0 / kappa")

    @property
    def nearly_incompressible(self) -> bool:
        return True  # at the critical state it is

    @property
    def pressure(self):
        """Pressure P_0 at F = I, Pa."""
        return -np.mean(self.initial_stress, axis=-1)

    @property
    def _deviator(self):
        return np.asarray(self.initial_stress) + np.asarray(self.pressure)[..., None]

    @property
    def prestretch(self):
        """Principal elastic stretches at F = I but for the volume's (3,)."""
        return np.exp(self._deviator / (2 * np.asarray(self.shear)[..., None]))

    @property
    def yield_pressure(self):
        """Size P_c of the yield surface at the start, Pa."""
        Q2 = 1.5 * (self._deviator**2).sum(axis=-1)
        return self.OCR * (self.pressure + Q2 / (self.M**2 * self.pressure))

    @staticmethod
    def trial(F, prestretch, plastic):
        """Return volume strain and square of the distortion, e_s^2 = 2/3 e : e, of the trial strain."""
        strain = Trial(F, plastic, prestretch)
        e = strain.deviatoric
        return {"volume": strain.volumetric, "distortion": 2 / 3 * ufl.inner(e, e), "strain": strain}

    @staticmethod
    def residual(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper):
        """Return the equation of d: the flow rule, on the yield surface."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        c, P = 6 * shear * kappa / M**2, to.trial_pressure * ufl.exp(-to.compaction)
        rule = (c * to.compaction - (ufl.exp(to.flow) - 1) * (1 - to.steepness) * P) / (c + P)
        rule = ufl.conditional(
            ufl.lt(to.flow, -SAME), 1 / SAME, rule
        )  # soil that softens fast has another root, back in time
        return {"steeper": ufl.conditional(to.yields, rule, steeper)}

    @staticmethod
    def kirchhoff(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper):
        """Return the Kirchhoff stress (3, 3), Pa, as UFL."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        a, h = (ufl.conditional(to.yields, value, 0.0) for value in (to.compaction, to.flow))
        deviator = 2 * shear * ufl.exp(-h) * trial["strain"].deviatoric
        return deviator - to.trial_pressure * ufl.exp(-a) * ufl.Identity(3)

    @staticmethod
    def update(trial, shear, M, lambda_, kappa, pressure, yield_pressure, plastic, consolidated, steeper):
        """Return the state at the end of the step, name -> UFL."""
        to = _Return(trial, shear, M, lambda_, kappa, pressure, yield_pressure, consolidated, steeper)
        strain = trial["strain"]
        a = to.compaction
        ratio = ufl.exp(-to.flow)
        volume = strain.volumetric + kappa * a
        b = strain.isotropic(lambda e: ufl.exp(2 * volume / 3 + ratio * (ufl.ln(e) - 2 * strain.volumetric / 3)))
        back = ufl.inv(strain.F)
        return {
            "plastic": ufl.conditional(to.yields, back * b * back.T, plastic),
            "consolidated": consolidated + ufl.conditional(to.yields, to.rho * a, 0.0),
        }


LC = {"r": "> kappa / lambda_, <= 1", "beta": ">= 0 1/Pa and finite", "reference": "> 0 Pa and finite"}
"""Constants of the loading-collapse curve, and their ranges."""


def _dried(function: Callable) -> Callable:
    """Return one of Modified Cam Clay's functions as it is under suction: of another lambda and P_c."""
    taken = Skeleton.taken_by(function)

    def of(**given):
        wet, kappa, consolidated = (given[name] for name in ("lambda_", "kappa", "consolidated"))

        def slope(s):
            return wet * (1 - (1 - given["r"]) * (1 - ufl.exp(-given["beta"] * s)))

        def power(s):
            return (wet - kappa) / (slope(s) - kappa)

        start = ufl.ln(given["yield_pressure"] / given["reference"])
        begun = ufl.conditional(ufl.gt(start, 0), start / power(given["suction_at_start"]), start)
        size = begun + consolidated  # ln(P_c0 / P_r)
        s = ufl.conditional(ufl.gt(size, 0), given["trial"]["suction"], 0.0)
        dried = consolidated + (power(s) - 1) * size + (begun - start)  # ln of P_c over that at the start
        out = function(**({name: given[name] for name in taken} | {"lambda_": slope(s), "consolidated": dried}))
        if function is ModifiedCamClay.update:
            out["consolidated"] = consolidated + (out["consolidated"] - dried) / power(s)
        return out

    of.__signature__ = Signature([Parameter(name, Parameter.KEYWORD_ONLY) for name in (*taken, *DRIED[1:], *LC)])
    of.__qualname__ = function.__qualname__
    return of


@dataclass(frozen=True, kw_only=True)
class BarcelonaBasic(ModifiedCamClay):
    """Modified Cam Clay whose yield surface grows with suction: soil that collapses as it gets wet.

    At a suction s = max(-p, 0) the yield surface in Bishop's stress has the size

        P_c / P_r = (P_c0 / P_r)^((lambda(0) - kappa) / (lambda(s) - kappa)),
        lambda(s) = lambda(0) [(1 - r) exp(-beta s) + r],   dP_c0 / P_c0 = -de_v^p / (lambda(0) - kappa),

    the loading-collapse curve of the Barcelona Basic Model; P_c0 is the size in saturated soil.  So soil of a constant
    suction is Modified Cam Clay with lambda(s), and saturated soil with lambda(0).  Strength by suction, and swelling
    on wetting, follow from Bishop's stress.  The suction is that of the end of a substep.  Where P_c0
    has fallen to P_r, suction changes nothing.

    Parameters
    ----------
    lambda_
        Slope lambda(0) of saturated soil.
    OCR
        Overconsolidation ratio, -, >= 1: P_c at the suction of the start over that through the initial stress.
    initial_stress : (3,), Pa
        Bishop's effective stresses at F = I.
    r
        lambda of very dry soil over lambda(0), -, > kappa / lambda_, <= 1.
    beta
        How fast lambda falls with suction, 1/Pa, >= 0.
    reference
        Stress P_r, Pa, > 0, at which suction changes nothing; a hundredth to a half of P_c0 is usual.

    The other parameters are those of `ModifiedCamClay`.  In a scene with fluid `retention` must be given.  The state is
    that of Modified Cam Clay, `consolidated` that of P_c0, and `suction`, Pa.  Alonso, Gens and Josa (1990); in
    Bishop's stress Bolzon, Schrefler and Zienkiewicz (1996).

    Raises
    ------
    ValueError
        Naming the constant that is out of its range, or is not given.
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
    """The return to the yield surface that an unknown d stands for.

    compaction, flow: a and h; steepness: w exp(-d), the square of Q / (M P) at the end; trial_pressure: P_t, Pa; rho:
    change of ln P_c over a; yields: whether the trial stress is outside.
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
