"""The imperfections of a sensor, applied to one reading of all runs at a time.

In order: scale factor and misalignment, bias and drift, white noise with outliers, saturation,
quantization, deadband, stuck-at faults, dropout. All errors are tangent vectors of the reading, so
the bias of an attitude is a rotation. The caller draws the random numbers (`Draws`), so the same
functions serve batches and environments. `advance` updates the errors and faults, which do not
depend on the true reading; `respond` applies them to the true reading.

Sources: Gauss-Markov drift and its discretization: Gelb 1974, sec. 3.8; bursts: Gilbert 1960.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import gammaincinv, ndtr, ndtri

from estbench.shapes import Array, Bool, Float, Mask
from estbench.spaces.manifold import Manifold

Draws = dict[str, Float[Array, "run _"]]
"""Purpose -> random numbers for one reading, or for the start."""


@dataclass(frozen=True, eq=False)
class Imperfections:
    """Every error of a sensor but its white noise; 0 switches an error off.

    Attributes, an array having one number per tangent coordinate:
        bias: std of a constant drawn once per run.
        walk: intensity of a random walk, unit/√s.
        drift: stationary std of a first-order Gauss-Markov drift.
        drift_time: correlation time of the drift, s.
        scale_factor: std of the relative gain error of each axis.
        misalignment: std of the rotation of a three-axis sensor, rad.
        quantization: step.
        cutoff: saturation at ± this value; infinite for none.
        deadband: readings of smaller magnitude become zero.
        outlier_probability: probability that a reading is an outlier.
        outlier_scale: factor on the noise of an outlier.
        student_dof: degrees of freedom of Student-t noise with covariance R; 0 for Gaussian noise.
        dropout: mean share of readings lost.
        dropout_length: mean length of a gap, readings; 1 for independent losses.
        stuck: probability that a stuck-at fault begins at a reading.
        stuck_length: mean length of a stuck-at fault, readings.
    """

    bias: Float[Array, " m"]
    walk: Float[Array, " m"]
    drift: Float[Array, " m"]
    scale_factor: Float[Array, " m"]
    quantization: Float[Array, " m"]
    cutoff: Float[Array, " m"]
    deadband: Float[Array, " m"]
    drift_time: float = 100.0
    misalignment: float = 0.0
    outlier_probability: float = 0.0
    outlier_scale: float = 10.0
    student_dof: float = 0.0
    dropout: float = 0.0
    dropout_length: float = 1.0
    stuck: float = 0.0
    stuck_length: float = 10.0

    def normals(self, m: int) -> dict[str, int]:
        """Purpose -> count of standard normals per reading, for the errors in use."""
        return {
            purpose: m
            for purpose, used in (("walk", self.walk.any()), ("drift", self.drift.any()))
            if used
        }

    def uniforms(self) -> dict[str, int]:
        """Purpose -> count of uniforms on [0, 1) per reading, for the errors in use."""
        used = (
            ("outlier", self.outlier_probability),
            ("student", self.student_dof),
            ("dropout", self.dropout),
            ("stuck", self.stuck),
        )
        return {purpose: 1 for purpose, value in used if value}

    def constants(self, m: int) -> dict[str, int]:
        """Purpose -> count of standard normals at the start, for the errors in use."""
        used = (
            ("bias", self.bias.any(), m),
            ("drift0", self.drift.any(), m),
            ("scale_factor", self.scale_factor.any(), m),
            ("misalignment", self.misalignment, 3),
        )
        return {purpose: width for purpose, value, width in used if value}


@dataclass(frozen=True, eq=False)
class State:
    """The state of a sensor in each run.

    Attributes:
        bias: constant plus random walk.
        drift: Gauss-Markov drift.
        error: additive error of this reading: bias, drift and noise.
        gain: matrix that multiplies the true reading, or None for the identity.
        last: last reading that was delivered, or None where none has been kept.
        stuck: whether the sensor has a stuck-at fault.
        lost: whether this reading is lost.
        time: time of the last reading, s, 0 before the first; an array where the runs differ.
    """

    bias: Float[Array, "run m"]
    drift: Float[Array, "run m"]
    error: Float[Array, "run m"]
    gain: Float[Array, "run m m"] | None
    last: Float[Array, "run ny"] | None
    stuck: Bool[Mask, " run"]
    lost: Bool[Mask, " run"]
    time: float | Float[Array, "run 1"] = 0.0


def start(imperfections: Imperfections, draws: Draws, runs: int, m: int) -> State:
    """The state of the sensor at t = 0.

    Args:
        imperfections: the sensor's imperfections.
        draws: standard normals as `Imperfections.constants` counts them.
        runs: count of runs.
        m: count of tangent coordinates.
    """
    zero = np.zeros((runs, m))
    gain = None
    if "scale_factor" in draws or "misalignment" in draws:
        gain = np.broadcast_to(np.eye(m), (runs, m, m)).copy()
        if "scale_factor" in draws:
            gain += (imperfections.scale_factor * draws["scale_factor"])[:, :, None] * np.eye(m)
        if "misalignment" in draws:
            x, y, z = (imperfections.misalignment * draws["misalignment"]).T
            o = np.zeros(runs)
            turn = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(runs, 3, 3)
            gain = gain + turn  # small angles
    no = np.zeros(runs, bool)
    bias = imperfections.bias * draws["bias"] if "bias" in draws else zero
    drift = imperfections.drift * draws["drift0"] if "drift0" in draws else zero
    return State(bias, drift, zero, gain, None, no, no)


def advance(
    imperfections: Imperfections,
    noise: Float[Array, "run m"],
    state: State,
    draws: Draws,
    time: float | Float[Array, "run 1"],
) -> State:
    """The state of the sensor at its next reading: errors, stuck-at faults and losses."""
    step, first = time - state.time, np.ravel(state.time) == 0.0
    bias, drift, stuck, lost = state.bias, state.drift, state.stuck, state.lost
    if "walk" in draws:
        bias = bias + imperfections.walk * np.sqrt(step) * draws["walk"]
    if "drift" in draws:
        keep = np.exp(-step / imperfections.drift_time)
        drift = keep * drift + imperfections.drift * np.sqrt(1.0 - keep**2) * draws["drift"]
    if "student" in draws:
        noise = noise * _student_scale(draws["student"], imperfections.student_dof)
    if "outlier" in draws:
        hit = draws["outlier"] < imperfections.outlier_probability
        noise = noise * np.where(hit, imperfections.outlier_scale, 1.0)
    if "stuck" in draws:
        chance = draws["stuck"][:, 0]
        stuck = np.where(
            stuck, chance >= 1.0 / imperfections.stuck_length, chance < imperfections.stuck
        )
        stuck &= ~first  # there is no earlier reading to repeat
    if "dropout" in draws:
        chance = draws["dropout"][:, 0]
        lost = chance < imperfections.dropout
        if imperfections.dropout_length > 1.0:
            leave = 1.0 / imperfections.dropout_length
            # Gilbert's Markov chain. With this probability of entering a gap, and `dropout` as the
            # probability of a gap at t = 0, the share of lost readings is `dropout` at any time.
            enter = leave * imperfections.dropout / (1.0 - imperfections.dropout)
            chain = np.where(state.lost, chance >= leave, chance < enter)
            lost = np.where(first, lost, chain)
    error = bias + drift + noise
    return replace(
        state, bias=bias, drift=drift, error=error, stuck=stuck, lost=lost, time=time
    )  # fmt: skip


def respond(
    imperfections: Imperfections,
    space: Manifold,
    clean: Float[Array, "run ny"],
    state: State,
    rows: Bool[Mask, " run"] | None = None,
) -> tuple[Float[Array, "run ny"], State]:
    """The reading of a true reading, and the state with the reading stored.

    Args:
        imperfections: the sensor's imperfections.
        space: the manifold of its readings.
        clean: noise-free readings.
        state: from `advance`.
        rows: runs that sample now, None for all; the others keep their last reading.
    """
    y = clean if state.gain is None else (state.gain @ clean[..., None])[..., 0]
    y = space.plus(y, state.error)
    if space.flat:
        y = _transfer(imperfections, y)
    if not imperfections.stuck:
        return y, state
    if state.last is not None:
        y = np.where(state.stuck[:, None], state.last, y)
    last = y if rows is None or state.last is None else np.where(rows[:, None], y, state.last)
    return y, replace(state, last=last)


def _transfer(imperfections: Imperfections, y: Float[Array, "run m"]) -> Float[Array, "run m"]:
    """Saturation, quantization and deadband of readings."""
    if np.isfinite(imperfections.cutoff).any():
        y = np.clip(y, -imperfections.cutoff, imperfections.cutoff)
    if imperfections.quantization.any():
        step = np.where(imperfections.quantization > 0, imperfections.quantization, 1.0)
        y = np.where(imperfections.quantization > 0, step * np.round(y / step), y)
    if imperfections.deadband.any():
        y = np.where(np.abs(y) < imperfections.deadband, 0.0, y)
    return y


def _student_scale(uniform: Float[Array, "run 1"], dof: float) -> Float[Array, "run 1"]:
    """Factor that turns Gaussian into Student-t noise of equal covariance (dof > 2)."""
    return np.exp(np.interp(ndtri(uniform), *_student_table(dof)))


@cache
def _student_table(dof: float) -> tuple[Array, Array]:
    """Quantiles of the standard normal, and the logarithm of the factor there.

    Linear interpolation has an error of 1e-6 and is many times faster than the inverse function.
    """
    quantiles = np.linspace(-7.1, 7.1, 4001)  # the tails beyond have a probability of 1e-12
    chi2 = 2.0 * gammaincinv(0.5 * dof, ndtr(quantiles))
    return quantiles, 0.5 * np.log((dof - 2.0) / chi2)
