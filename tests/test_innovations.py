"""A store that keeps everything: ν and S of every update, also where readings miss or come late."""

import numpy as np
import pytest
from scipy import stats

import estbench
from estbench import experiment, setup
from estbench.analysis.compare import compare_stores
from estbench.innovations import listen, readings
from estbench.manifold import Manifold

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


@pytest.mark.parametrize("label", ["ekf", "rts", "pf"])  # one looks back, one takes random keys
def test_listening_changes_no_number(label):
    prepared = setup.build(experiment.resolve("pendulum", [label], runs=3, duration=0.2))
    plain, full = (experiment.run_batch(prepared, range(3), k) for k in ("diagonal", "full"))
    for name, value in plain.records[label].items():
        if name != "cpu_time":
            np.testing.assert_array_equal(value, full.records[label][name])


def test_the_names_of_readings_and_of_the_class():
    spaces = {"a": Manifold.euclidean(1), "b": Manifold.euclidean(2, ["x", "y"])}
    assert readings(spaces) == ("a", "b.x", "b.y")
    prepared = setup.build(experiment.resolve("pendulum", ["ekf"], runs=1, duration=0.1))
    heard = listen(prepared.estimator("ekf"), prepared.channel_spaces, [0.1], 1)
    assert type(heard).__name__ == "EKF"
    assert not hasattr(heard, "smooth")


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
    rejected = 0
    for w in white:
        N = m * steps
        c0 = (w**2).sum() / N
        rho = [(w[k:] * w[:-k]).sum() / (m * (steps - k)) / c0 for k in range(1, 11)]
        Q = (N + 2) / N * sum(m * (steps - k) * r**2 for k, r in enumerate(rho, 1))
        rejected += bool(stats.chi2.ppf(0.95, 10) < Q)
    assert f.whiteness is not None
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
