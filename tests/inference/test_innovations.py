"""A store that keeps everything: ν and S of every update, also where readings miss or come late."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import estbench
from estbench.analysis.compare import compare_stores
from estbench.estimators.ekf import EKF
from estbench.estimators.protocol import Innovation
from estbench.experiment import setup
from estbench.inference.innovations import Innovations, readings
from estbench.inference.run_subset import ALL
from estbench.montecarlo import run as experiment
from estbench.montecarlo.batch import run_batch
from estbench.spaces.manifold import Manifold

LATE = ["channels.pole_encoder.latency=0.02", "channels.cart_encoder.dropout=0.3"]


@pytest.mark.parametrize(
    ("scenario", "overrides"), [("cartpole", []), ("cartpole", LATE), ("quadrotor", [])]
)
def test_nis_and_dof_follow_from_what_is_stored(tmp_path, scenario, overrides):
    estbench.run(
        scenario, ["ekf"], runs=6, duration=0.3, batch_size=4, out=tmp_path / "x", keep="full",
        overrides=overrides,
    )  # fmt: skip
    with estbench.open_results(tmp_path / "x") as tree:
        ekf = tree["ekf"].to_dataset().load()
        names = tree["reading"].to_numpy()
    v, S = ekf["innovation"].to_numpy(), ekf["innovation_cov"].to_numpy()
    came = np.isfinite(v)
    assert v.shape == (6, len(ekf["time"]), len(names))
    np.testing.assert_array_equal(came.sum(axis=-1), ekf["dof"])
    np.testing.assert_array_equal(np.isfinite(S), came[..., None] & came[..., None, :])
    assert not came[:, 0].any()
    some = False
    for run, step in np.argwhere(came.any(axis=-1)):
        w = came[run, step]
        some |= not w.all()
        x, block = v[run, step, w], S[run, step][np.ix_(w, w)]
        nis = x @ np.linalg.solve(block, x)
        assert float(ekf["nis"][run, step]) == pytest.approx(nis, rel=1e-6)
    assert some == (overrides == LATE or scenario == "quadrotor")


LATE_IN_FEW = ("channels.encoder.latency_std=0.005", "filter.window=0.05")


@pytest.mark.parametrize("overrides", [(), LATE_IN_FEW], ids=["on time", "late in few"])
@pytest.mark.parametrize("label", ["ekf", "rts", "pf"])  # one looks back, one takes random keys
def test_keeping_everything_changes_no_number(label, overrides, monkeypatch):
    """Nor what is fused again: of the EKF, the rows of every update are counted."""
    rows, update = [], EKF.update

    def counted(self, belief, y, *arguments, **named):
        rows.append(len(y))
        return update(self, belief, y, *arguments, **named)

    monkeypatch.setattr(EKF, "update", counted)
    prepared = setup.build(
        experiment.resolve("pendulum", [label], duration=0.15, overrides=overrides)
    )
    plain = run_batch(prepared, range(16), "diagonal")
    before = rows.copy()
    full = run_batch(prepared, range(16), "full")
    assert rows == 2 * before
    assert (label == "ekf" and bool(overrides)) == any(0 < n < 16 for n in rows)
    for name, value in plain.records[label].items():
        if name != "cpu_time":
            np.testing.assert_array_equal(value, full.records[label][name])


SPACES = {"a": Manifold.euclidean(1), "b": Manifold.euclidean(2, ["x", "y"])}


def test_the_names_of_readings():
    assert readings(SPACES) == ("a", "b.x", "b.y")


def innovation(value, dof, runs=3):
    """Of `value` in every component, with S = value² I; `dof` per run."""
    m = max(dof)
    full = np.full((runs, m), float(value))
    S = np.tile(value**2 * np.eye(m), (runs, 1, 1))
    return Innovation(full, S, full / value, np.asarray(dof) * 1.0, np.asarray(dof))


def test_an_update_of_some_runs_leaves_the_others_and_a_replay_replaces():
    noted = Innovations(SPACES, 2, 3, keep=True)
    noted.clear(1, ALL)
    noted.put(1, 0, ("b",), innovation(2, [2, 2, 2]), None, ALL)
    # A late reading of `a` in run 2: it is updated again, alone, twice in the rows.
    rows = np.array([2, 2])
    noted.clear(1, rows)
    noted.put(1, 0, ("a", "b"), innovation(5, [3, 3], runs=2), None, rows)
    found, nan = noted.traces(), np.nan
    np.testing.assert_array_equal(found["nis"], [[nan] * 3, [2, 2, 3]])
    np.testing.assert_array_equal(found["dof"], [[0] * 3, [2, 2, 3]])
    assert np.isnan(found["innovation"][:2]).all()
    np.testing.assert_array_equal(found["innovation"][2], [[nan, 2, 2], [nan, 2, 2], [5, 5, 5]])
    np.testing.assert_array_equal(
        found["innovation_cov"][2, 0], [[nan, nan, nan], [nan, 4, 0], [nan, 0, 4]]
    )
    np.testing.assert_array_equal(found["innovation_cov"][2, 2], 25 * np.eye(3))


def test_what_was_only_gathered_is_not_noted():
    """A start puts readings by: of no degrees of freedom, whatever ν and S it answers."""
    noted = Innovations(SPACES, 3, 3, keep=True)
    noted.put(0, 0, ("b",), replace(innovation(2, [2, 2, 2]), dof=np.zeros(3, int)), None, ALL)
    noted.put(1, 0, ("b",), innovation(2, [2, 2, 0]), np.ones((3, 2), bool), ALL)
    noted.put(2, 0, ("b",), innovation(2, [2, 2, 2]), None, ALL)
    found = noted.traces()
    assert found["innovation_cov"].shape == (4, 3, 3, 3)
    np.testing.assert_array_equal(found["dof"][:, 2], [0, 0, 2])
    np.testing.assert_array_equal(np.isfinite(found["innovation"][1:, 2, 1]), [False, False, True])
    np.testing.assert_array_equal(found["lag_terms"][:, :2], [[4, 2], [4, 2], [2, 0]])


def test_without_keep_there_is_no_memory_of_it():
    noted = Innovations(SPACES, 2, 3)
    noted.put(1, 0, ("b",), innovation(2, [2, 2, 2]), None, ALL)
    assert noted.traces()["innovation"] is None
    assert noted.traces()["innovation_cov"] is None


def test_the_tables_follow_from_what_is_stored(tmp_path):
    """Every figure of `compare` on one estimator, from the traces, by the textbook's formulas."""
    overrides = ["filter.process_noise_scale=0.3"]
    estbench.run(
        "cartpole", ["ekf"], runs=30, duration=0.8, batch_size=8, out=tmp_path / "x", keep="full",
        overrides=overrides,
    )  # fmt: skip
    with estbench.open_results(tmp_path / "x") as tree:
        ekf = tree["ekf"].to_dataset().load()
    f = compare_stores([tmp_path / "x"]).contests[0].findings[0]
    e, P, v, S = (
        ekf[k].to_numpy()[:, 1:] for k in ("error", "cov", "innovation", "innovation_cov")
    )
    runs, steps, m = v.shape
    assert not ekf["diverged"].any()
    # Ljung & Box, one run at a time; ten lags and no parameter fitted: ten degrees of freedom
    white = np.linalg.solve(np.linalg.cholesky(S), v[..., None])[..., 0]
    rejected, first = 0, []
    for w in white:
        N = m * steps
        c0 = (w**2).sum() / N
        rho = [(w[k:] * w[:-k]).sum() / (m * (steps - k)) / c0 for k in range(1, 11)]
        first.append(rho[0])
        Q = (N + 2) / N * sum(m * (steps - k) * r**2 for k, r in enumerate(rho, 1))
        rejected += bool(stats.chi2.ppf(0.95, 10) < Q)
    assert f.summary.lag_one.value == pytest.approx(np.mean(first))
    assert f.whiteness is not None
    assert f.whiteness.correlation[0] == f.summary.lag_one
    assert f.whiteness.rejected.value == pytest.approx(rejected / runs)
    # Li & Zhao
    nees = np.einsum("rki,rkij,rkj->rk", e, np.linalg.inv(P), e)
    square = np.einsum("rki,rkj->kij", e, e) / runs
    best = np.einsum("rki,kij,rkj->rk", e, np.linalg.inv(square), e)
    ratio = 10 * np.log10(nees / best)
    assert f.nci == pytest.approx(np.abs(ratio).mean(), rel=1e-6)
    assert f.inclination == pytest.approx(ratio.mean(), rel=1e-6)
    # coverage, ANEES, RMSE
    sigma = np.sqrt(np.einsum("rkii->rki", P))
    assert f.coverage is not None
    for i, c in enumerate(f.coverage):
        for k, share in enumerate(c.shares, 1):
            expected = (np.abs(e[..., i]) <= k * sigma[..., i]).mean()
            assert share.value == pytest.approx(expected)
    assert f.summary.anees.value == pytest.approx(nees.mean() / 4)
    np.testing.assert_allclose(
        [r.value for r in f.summary.rmse], np.sqrt((e**2).mean(axis=(0, 1))), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("name", "overrides"), [("cartpole", []), ("quadrotor", ["channels.position.dropout=0.3"])]
)
def test_what_is_said_of_each_run_follows_from_what_is_stored(name, overrides, tmp_path):
    """Blocks, moments, log-likelihood and NIS by channel, from error, σ, ν and S."""
    estbench.run(
        name, ["ekf"], runs=5, duration=0.4, out=tmp_path / "x", keep="full",
        overrides=[*overrides, "consistency.burn_in=0.1"],
    )  # fmt: skip
    with estbench.open_results(tmp_path / "x") as tree:
        ekf, times = tree["ekf"].to_dataset().load(), tree["time"].to_numpy()
        channels = [str(c) for c in tree["channel"].to_numpy()]
        readings_ = [str(r) for r in tree["reading"].to_numpy()]
    v, S = ekf["innovation"].to_numpy(), ekf["innovation_cov"].to_numpy()
    late = np.flatnonzero(times > 0.1 + 1e-12)
    owner = np.array([channels.index(r.split(".")[0]) for r in readings_])
    likelihood = np.zeros(5)
    square, number = np.zeros((2, 5, len(late), len(channels)))
    for run in range(5):
        for i, k in enumerate(late):
            came = np.isfinite(v[run, k])
            if not came.any():
                continue
            part = S[run, k][np.ix_(came, came)]
            zero = np.zeros(came.sum())
            likelihood[run] += stats.multivariate_normal.logpdf(v[run, k][came], zero, part)
            white = np.linalg.solve(np.linalg.cholesky(part), v[run, k][came])
            np.add.at(square[run, i], owner[came], white**2)
            np.add.at(number[run, i], owner[came], 1)
    np.testing.assert_allclose(ekf["log_likelihood"], likelihood, rtol=1e-9)
    np.testing.assert_array_equal(ekf["received"], number.sum(axis=(1, 2)))
    ratio = np.where(number > 0, square / np.maximum(number, 1), np.nan)
    np.testing.assert_allclose(ekf["channel_nis"], np.nanmean(ratio, axis=1), rtol=1e-7)
    e, sigma, nees = (ekf[x].to_numpy() for x in ("error", "std", "nees"))
    n = e.shape[-1]
    for j, inside in enumerate(np.array_split(late, 10)):
        part = e[:, inside] / sigma[:, inside]
        np.testing.assert_allclose(ekf["scaled_error"][:, j], part.mean(axis=1), atol=1e-12)
        np.testing.assert_allclose(ekf["scaled_square"][:, j], (part**2).mean(axis=1))
        np.testing.assert_allclose(ekf["nees_by_block"][:, j], nees[:, inside].mean(axis=1) / n)
    np.testing.assert_allclose(ekf["mean_error"], e[:, late].mean(axis=1))
    np.testing.assert_allclose(ekf["mean_cube"], (e[:, late] ** 3).mean(axis=1))
    size = np.log(sigma[:, late] ** 2).mean(axis=-1)
    for run in range(5):
        small = size[run] < np.median(size[run])
        expected = [nees[run, late][part].mean() / n for part in (small, ~small)]
        np.testing.assert_allclose(ekf["nees_by_size"][run], expected)
