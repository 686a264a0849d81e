"""What a sensor does to the true reading. The statistical tests refuse a correct program with a
probability below 1e-6 each: a mean or a variance is compared at six standard deviations (2e-9)."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from estbench.randomness import streams
from estbench.sensors import imperfections
from estbench.sensors.imperfections import Imperfections
from estbench.spaces.manifold import Manifold

DT = 0.01
LINE, AXES = Manifold.euclidean(1), Manifold.euclidean(3)
TURN = Manifold(("rx", "ry", "rz"), ("rad",) * 3, np.array([[0, 0]]))


def ideal(m=1, **parts: Any):
    zero = np.zeros(m)
    names = ("bias", "walk", "drift", "scale_factor", "quantization", "deadband")
    given: dict[str, Any] = {"cutoff": zero + np.inf, **dict.fromkeys(names, zero)}
    for name, value in parts.items():
        given[name] = np.full(m, value) if name in given else value
    return Imperfections(**given)


def simulate(part, space=LINE, readings=1, runs=4000, clean=None, std=0.0, first=DT, seed=3):
    """Readings `(reading, run, ny)` and masks `(reading, run)` of a true reading that is still."""
    m, purpose = space.n, "sensor:a:"
    runs = range(runs)

    def draw(kind, named, count):
        return {k: kind(seed, runs, purpose + k, count, w) for k, w in named.items()}

    draws = draw(streams.normals, part.normals(m), readings)
    draws |= draw(streams.uniforms, part.uniforms(), readings)
    constants = {k: v[0] for k, v in draw(streams.normals, part.constants(m), 1).items()}
    noise = std * streams.normals(seed, runs, "sensor:a", readings, m)
    if clean is None:
        clean = np.zeros(space.nx)
        clean[space.quaternions[:, 0]] = 1.0
    clean = np.broadcast_to(clean, (len(runs), space.nx)).astype(float)
    state, y, masks = imperfections.start(part, constants, len(runs), m), [], []
    for j in range(readings):
        now = {k: v[j] for k, v in draws.items()}
        state = imperfections.advance(part, noise[j], state, now, first + j * DT)
        read, state = imperfections.respond(part, space, clean, state)
        y.append(read)
        masks.append(~state.lost)
    return np.array(y), np.array(masks)


def assert_variance(sample, expected, sigmas=6.0):
    sample = np.ravel(sample)
    error = expected * np.sqrt(2 / sample.size)
    assert abs(sample.var() - expected) < sigmas * error + 1e-300
    assert abs(sample.mean()) < sigmas * np.sqrt(expected / sample.size) + 1e-300


# Noise and drift


def test_without_imperfections_the_reading_is_the_true_one_plus_noise():
    y, masks = simulate(ideal(3), AXES, clean=[1.0, 2.0, 3.0], readings=5)
    np.testing.assert_array_equal(y, np.broadcast_to([1.0, 2.0, 3.0], y.shape))
    assert masks.all()
    assert not ideal(3).normals(3)
    assert not ideal(3).uniforms()
    assert not ideal(3).constants(3)


def test_a_bias_is_drawn_once_a_run():
    y, _ = simulate(ideal(bias=0.3), readings=4)
    np.testing.assert_array_equal(y, np.broadcast_to(y[:1], y.shape))
    assert_variance(y[0], 0.09)


def test_a_random_walk_grows_with_the_square_root_of_time():
    walk = 0.2
    y, _ = simulate(ideal(walk=walk), readings=50, first=0.04)
    path = y[..., 0]
    assert_variance(path[0], walk**2 * 0.04)
    assert_variance(path[-1], walk**2 * (0.04 + 49 * DT))
    steps = np.diff(path, axis=0)
    assert_variance(steps, walk**2 * DT)
    assert stats.kstest(steps.ravel()[:20000] / (walk * np.sqrt(DT)), "norm").pvalue > 1e-7
    # Steps do not remember each other.
    assert abs((steps[1:] * steps[:-1]).mean()) < 6 * walk**2 * DT / np.sqrt(steps[1:].size)


def test_a_random_walk_does_not_depend_on_the_rate():
    """Half the readings, each of twice the time: the same spread."""
    part, state = ideal(walk=1.0), None
    z = streams.normals(0, range(4000), "z", 10, 1)
    state = imperfections.start(part, {}, 4000, 1)
    for j in range(10):
        none = np.zeros((4000, 1))
        state = imperfections.advance(part, none, state, {"walk": z[j]}, 0.3 * (j + 1))
    assert_variance(state.error, 3.0)


@pytest.mark.parametrize("time", [0.05, 1.0])
def test_a_gauss_markov_drift_is_stationary_and_forgets_exponentially(time):
    drift = 0.4
    y, _ = simulate(ideal(drift=drift, drift_time=time), readings=31)
    path = y[..., 0]
    for j in (0, 1, 15, 30):
        assert_variance(path[j], drift**2)
    for lag in (1, 5, 30):
        kept = np.exp(-lag * DT / time)
        products = path[0] * path[lag]
        error = drift**2 * np.sqrt((1 + kept**2) / products.size)
        assert abs(products.mean() - drift**2 * kept) < 6 * error


def test_white_noise_is_white():
    y, _ = simulate(ideal(dropout=0.0), readings=50, std=0.5)
    assert_variance(y, 0.25)
    assert abs((y[1:] * y[:-1]).mean()) < 6 * 0.25 / np.sqrt(y[1:].size)


def test_student_noise_has_the_covariance_r_and_heavy_tails():
    dof = 6.0
    y, _ = simulate(ideal(3, student_dof=dof), AXES, readings=20, runs=2000, std=0.5)
    scale = 0.5 * np.sqrt((dof - 2) / dof)
    axis = y[..., 0].ravel()
    assert stats.kstest(axis / scale, stats.t(dof).cdf).pvalue > 1e-7
    fourth = 3 * (dof - 2) / (dof - 4)  # kurtosis; the variance of the sample variance
    for k in range(3):
        axis = y[..., k]
        assert abs(axis.var() - 0.25) < 6 * 0.25 * np.sqrt((fourth - 1) / axis.size)
    # One factor for the three axes: their sizes go together.
    sizes = np.abs(y.reshape(-1, 3))
    assert np.corrcoef(sizes.T)[0, 1] > 0.05


@pytest.mark.parametrize("dof", [2.1, 5.0, 100.0])
def test_the_factor_of_student_noise_is_that_of_the_chi_square(dof):
    """t = z sqrt(dof/χ²), scaled to the variance of z; χ² by its inverse distribution function."""
    tails = [0.0, 2e-12, 1e-9, 1 - 1e-9, 1 - 2e-12]
    uniform = np.concatenate([tails, np.linspace(0.001, 0.999, 1001)])[:, None]
    found = imperfections._student_scale(uniform, dof)
    expected = np.sqrt((dof - 2) / stats.chi2(dof).ppf(uniform[1:]))
    np.testing.assert_allclose(found[1:], expected, rtol=2e-6)
    assert np.isfinite(found[0])  # the generator may return 0


def test_outliers_come_as_often_and_as_large_as_asked():
    p, scale, std = 0.1, 20.0, 0.01
    y, _ = simulate(ideal(outlier_probability=p, outlier_scale=scale), readings=10, std=std)
    share = stats.norm.sf(5 / scale) * 2 * p  # noise beyond five of its usual deviations
    hits = np.abs(y) > 5 * std
    assert abs(hits.mean() - share) < 6 * np.sqrt(share * (1 - share) / hits.size)
    mixture = std**2 * (1 - p + p * scale**2)
    kurtosis = 3 * std**4 * (1 - p + p * scale**4) / mixture**2
    assert abs(y.var() - mixture) < 6 * mixture * np.sqrt((kurtosis - 1) / y.size)


# The transfer function


def test_a_scale_factor_is_drawn_for_each_axis_of_each_run():
    y, _ = simulate(ideal(3, scale_factor=0.02), AXES, clean=[1.0, -2.0, 10.0])
    gain = y[0] / [1.0, -2.0, 10.0] - 1
    for k in range(3):
        assert_variance(gain[:, k], 0.0004)
    assert abs(np.corrcoef(gain.T)[0, 1]) < 6 / np.sqrt(len(gain))


def test_misalignment_turns_the_reading_by_a_small_rotation():
    angle = 0.01
    y, _ = simulate(ideal(3, misalignment=angle), AXES, clean=[0.0, 0.0, 2.0])
    np.testing.assert_array_equal(y[0, :, 2], 2.0)  # to first order
    for k in range(2):
        assert_variance(y[0, :, k], (2 * angle) ** 2)
    other, _ = simulate(ideal(3, misalignment=angle), AXES, clean=[3.0, 0.0, 0.0])
    # One rotation per run: z × x and x × z tell the same angle about y.
    np.testing.assert_allclose(other[0, :, 2] / -3.0, y[0, :, 0] / 2.0, atol=1e-15)


def test_saturation_quantization_and_deadband_in_this_order():
    values = np.linspace(-3, 3, 601)[:, None]
    y = simulate(ideal(cutoff=2.0), clean=values, runs=601)[0][0]
    np.testing.assert_array_equal(y, np.clip(values, -2, 2))
    y = simulate(ideal(quantization=0.25), clean=values, runs=601)[0][0]
    assert (np.abs(y - values) <= 0.125 + 1e-12).all()
    np.testing.assert_allclose(y / 0.25, np.round(y / 0.25), atol=1e-12)
    y = simulate(ideal(deadband=0.5), clean=values, runs=601)[0][0]
    np.testing.assert_array_equal(y, np.where(np.abs(values) < 0.5, 0.0, values))
    y = simulate(ideal(cutoff=2.1, quantization=0.5), clean=values, runs=601)[0][0]
    assert y.max() == 2.0
    assert y.min() == -2.0


def test_saturation_comes_after_the_noise():
    y, _ = simulate(ideal(cutoff=1.0), clean=[1.5], std=0.2, readings=5)
    assert y.max() == 1.0
    assert (y < 1.0).mean() == pytest.approx(stats.norm.cdf(-0.5 / 0.2), abs=0.005)


def test_axes_have_their_own_figures():
    part = replace(ideal(3), quantization=np.array([0.0, 0.5, 0.0]), bias=np.array([0.0, 0.0, 1.0]))
    y, _ = simulate(part, AXES, clean=[0.3, 0.3, 0.0])
    np.testing.assert_array_equal(y[0, :, :2], np.broadcast_to([0.3, 0.5], (4000, 2)))
    assert_variance(y[0, :, 2], 1.0)


def test_an_attitude_is_biased_by_a_rotation():
    y, _ = simulate(ideal(3, bias=0.1), TURN, readings=2)
    np.testing.assert_allclose(np.linalg.norm(y, axis=-1), 1.0)
    turned = TURN.minus(y[0], np.broadcast_to([1.0, 0, 0, 0], y[0].shape))
    for k in range(3):
        assert_variance(turned[:, k], 0.01)


# Faults


@pytest.mark.parametrize(("share", "length"), [(0.2, 1.0), (0.2, 4.0), (0.7, 8.0)])
def test_dropout_loses_its_share_at_any_time_in_gaps_of_its_length(share, length):
    _, masks = simulate(ideal(dropout=share, dropout_length=length), readings=60)
    runs = masks.shape[1]
    for j in (0, 1, 5, 59):
        assert abs((~masks[j]).mean() - share) < 6 * np.sqrt(share * (1 - share) / runs)
    # How a gap goes on and how it begins: probabilities of a chain, from all its transitions.
    leave = 1 / length if length > 1 else 1 - share
    enter = leave * share / (1 - share)
    lost, next_ = ~masks[:-1], ~masks[1:]
    for state, chance in ((lost, 1 - leave), (~lost, enter)):
        count = state.sum()
        assert abs(next_[state].mean() - chance) < 6 * np.sqrt(chance * (1 - chance) / count)


def test_a_stuck_sensor_repeats_its_last_reading():
    part = ideal(stuck=0.05, stuck_length=6.0)
    y, masks = simulate(part, readings=80, std=1.0)
    held = y[1:, :, 0] == y[:-1, :, 0]
    assert masks.all()
    assert not (y[0] == 0).any()
    going_on = held[1:][held[:-1]]
    begins = held[1:][~held[:-1]]
    for found, chance in ((going_on, 5 / 6), (begins, 0.05)):
        assert abs(found.mean() - chance) < 6 * np.sqrt(chance * (1 - chance) / found.size)


def test_only_the_runs_that_read_now_remember_it():
    part = ideal(stuck=0.5, stuck_length=2.0)
    state = imperfections.start(part, {}, 3, 1)
    free = {"stuck": np.ones((3, 1))}
    state = imperfections.advance(part, np.zeros((3, 1)), state, free, 0.1)
    y, state = imperfections.respond(part, LINE, np.full((3, 1), 1.0), state)
    state = imperfections.advance(part, np.zeros((3, 1)), state, free, 0.2)
    now = np.array([True, False, True])
    y, state = imperfections.respond(part, LINE, np.full((3, 1), 2.0), state, now)
    assert state.last is not None
    np.testing.assert_array_equal(state.last[:, 0], [2.0, 1.0, 2.0])
    stuck = {"stuck": np.zeros((3, 1))}
    state = imperfections.advance(part, np.zeros((3, 1)), state, stuck, 0.3)
    y, _ = imperfections.respond(part, LINE, np.full((3, 1), 3.0), state)
    np.testing.assert_array_equal(y[:, 0], [2.0, 1.0, 2.0])


# Common random numbers


def test_one_imperfection_more_changes_no_other_number():
    few, _ = simulate(ideal(bias=0.1, walk=0.1), readings=10, std=0.2)
    more, masks = simulate(ideal(bias=0.1, walk=0.1, dropout=0.3, stuck=1e-9), readings=10, std=0.2)
    np.testing.assert_array_equal(few[masks], more[masks])


def test_a_run_is_the_same_alone_and_among_others():
    part = ideal(
        3, bias=0.1, walk=0.1, drift=0.2, scale_factor=0.01, misalignment=0.01, quantization=0.01,
        cutoff=1.0, deadband=0.02, outlier_probability=0.1, student_dof=5.0, dropout=0.3,
        dropout_length=3.0, stuck=0.1,
    )  # fmt: skip
    few, kept = simulate(part, AXES, readings=20, runs=3, clean=[0.1, 0.5, -2.0], std=0.1)
    many, masks = simulate(part, AXES, readings=20, runs=50, clean=[0.1, 0.5, -2.0], std=0.1)
    np.testing.assert_array_equal(few, many[:, :3])
    np.testing.assert_array_equal(kept, masks[:, :3])
