"""What a sensor does to the true reading, one reading of all runs at a time.

In order: scale factor and misalignment, bias and drift, white noise with outliers, saturation,
quantization, deadband, stuck-at faults, dropout. Everything lives in the reading's tangent, so an
attitude is biased by a rotation. The random numbers are handed in (`Draws`), so that the same
functions serve a recorded batch and a live environment: `advance` is what happens to the sensor
whatever it looks at, `respond` what it then says.

Sources: Gauss-Markov drift and its discretization: Gelb 1974, sec. 3.8; bursts: Gilbert 1960.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.special import gammaincinv, ndtr, ndtri

from estbench.shapes import Array, Mask
from estbench.spaces.manifold import Manifold

Draws = dict[str, Array]
"""Purpose -> random numbers `(run, width)` of one reading, or of the start."""


@dataclass(frozen=True, eq=False)
class Imperfections:
    """Everything but the white noise; zero (or None) switches a part off.

    Attributes, per tangent coordinate `(m,)` where so said:
        bias: std of a constant drawn once a run, `(m,)`.
        walk: intensity of a random walk, unit/√s, `(m,)`.
        drift: stationary std of a first-order Gauss-Markov drift, `(m,)`.
        drift_time: its correlation time, s.
        scale_factor: std of the relative gain error of each axis, `(m,)`.
        misalignment: std of the rotation of a three-axis sensor, rad.
        quantization: step, `(m,)`.
        cutoff: saturation at ± this, `(m,)`; infinite for none.
        deadband: readings below this in size become zero, `(m,)`.
        outlier_probability, outlier_scale: chance that a reading's noise is that many times larger.
        student_dof: degrees of freedom of a Student-t noise with the covariance R; 0 for Gaussian.
        dropout: long-run share of readings lost.
        dropout_length: mean length of a gap, readings; 1 for independent losses.
        stuck: chance that a reading starts a stuck-at fault.
        stuck_length: mean length of it, readings.
    """

    bias: Array
    walk: Array
    drift: Array
    scale_factor: Array
    quantization: Array
    cutoff: Array
    deadband: Array
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
        """Purpose -> how many standard normals each reading needs, for the parts in use."""
        return {
            purpose: m
            for purpose, used in (("walk", self.walk.any()), ("drift", self.drift.any()))
            if used
        }

    def uniforms(self) -> dict[str, int]:
        """Purpose -> how many uniforms on [0, 1) each reading needs, for the parts in use."""
        used = (
            ("outlier", self.outlier_probability),
            ("student", self.student_dof),
            ("dropout", self.dropout),
            ("stuck", self.stuck),
        )
        return {purpose: 1 for purpose, value in used if value}

    def constants(self, m: int) -> dict[str, int]:
        """Purpose -> how many standard normals the start needs, for the parts in use."""
        used = (
            ("bias", self.bias.any(), m),
            ("drift0", self.drift.any(), m),
            ("scale_factor", self.scale_factor.any(), m),
            ("misalignment", self.misalignment, 3),
        )
        return {purpose: width for purpose, value, width in used if value}


@dataclass(frozen=True, eq=False)
class State:
    """A sensor's memory, a row a run.

    Attributes:
        bias: constant plus random walk `(run, m)`.
        drift: Gauss-Markov part `(run, m)`.
        error: what this reading adds to the true one: bias, drift and noise `(run, m)`.
        gain: matrix that multiplies the true reading `(run, m, m)`, or None for the identity.
        last: last delivered reading `(run, ny)`, or None where none has been kept.
        stuck: in a stuck-at fault `(run,)`.
        lost: in a gap; this reading does not arrive `(run,)`.
        time: of the last reading, s; 0 before the first; `(run, 1)` where the runs differ.
    """

    bias: Array
    drift: Array
    error: Array
    gain: Array | None
    last: Array | None
    stuck: Mask
    lost: Mask
    time: float | Array = 0.0


def start(imperfections: Imperfections, draws: Draws, runs: int, m: int) -> State:
    """The sensor as it is switched on; draws as `Imperfections.constants` asks."""
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
    imperfections: Imperfections, noise: Array, state: State, draws: Draws, time: float | Array
) -> State:
    """The sensor at its next reading: its error, and whether it is stuck or the reading lost."""
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
        stuck &= ~first  # there is nothing to be stuck at
    if "dropout" in draws:
        chance = draws["dropout"][:, 0]
        lost = chance < imperfections.dropout
        if imperfections.dropout_length > 1.0:
            leave = 1.0 / imperfections.dropout_length
            # Gilbert's chain: entered with this chance, and begun (at t = 0) in or out of a gap
            # with the share `dropout`, it loses that share of the readings at any time.
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
    clean: Array,
    state: State,
    rows: Mask | None = None,
) -> tuple[Array, State]:
    """What the sensor says of a true reading `(run, ny)`, and its memory of having said so.

    Args:
        imperfections: the sensor's imperfections.
        space: the manifold of its readings.
        clean: noise-free readings `(run, ny)`.
        state: from `advance`.
        rows: runs that read now `(run,)`; the others remember what they said before.
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


def _transfer(imperfections: Imperfections, y: Array) -> Array:
    """Saturation, quantization and deadband of readings `(run, m)`."""
    if np.isfinite(imperfections.cutoff).any():
        y = np.clip(y, -imperfections.cutoff, imperfections.cutoff)
    if imperfections.quantization.any():
        step = np.where(imperfections.quantization > 0, imperfections.quantization, 1.0)
        y = np.where(imperfections.quantization > 0, step * np.round(y / step), y)
    if imperfections.deadband.any():
        y = np.where(np.abs(y) < imperfections.deadband, 0.0, y)
    return y


def _student_scale(uniform: Array, dof: float) -> Array:
    """Factor `(run, 1)` that makes Gaussian noise Student-t of the same covariance (dof > 2)."""
    return np.exp(np.interp(ndtri(uniform), *_student_table(dof)))


@cache
def _student_table(dof: float) -> tuple[Array, Array]:
    """Logarithm of the factor at quantiles of the standard normal.

    Between them it is all but linear: to 1e-6, and many times faster than the inverse.
    """
    quantiles = np.linspace(-7.1, 7.1, 4001)  # beyond: 1e-12
    chi2 = 2.0 * gammaincinv(0.5 * dof, ndtr(quantiles))
    return quantiles, 0.5 * np.log((dof - 2.0) / chi2)
