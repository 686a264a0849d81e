"""The examples run and show what they say."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from estbench.commands import cli
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.montecarlo.batch import traced

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name, runs, duration, **options):
    return experiment.run(EXAMPLES / f"{name}.toml", runs=runs, duration=duration, **options)


def rmse(results, label):
    return np.array([i.value for i in results[label].rmse])


def test_a_wrong_start_is_mended_by_the_batch_fit_and_not_by_inflation():
    results = run("wrong_start", 20, 0.8)
    for label in ("cold", "inflated"):
        assert results[label].anees.low > 5.0
        assert (rmse(results, label) > 4.0 * rmse(results, "warm")).all()
    assert results["warm"].anees.value == pytest.approx(1.0, abs=0.2)


def test_a_sensor_bias_is_mended_by_bias_states_and_not_by_more_process_noise():
    results = run("sensor_bias", 20, 1.5)
    assert results["ekf"].anees.low > 5.0
    assert results["more_q"].anees.low > 1.5
    assert (rmse(results, "ekf") > 2.0 * rmse(results, "bias_ekf")).all()
    assert (rmse(results, "more_q") > 2.0 * rmse(results, "bias_ekf")).all()
    assert results["bias_ekf"].anees.value == pytest.approx(1.0, abs=0.2)
    assert (rmse(results, "consider") > rmse(results, "bias_ekf")).all()


def test_outliers_are_mended_by_gating_and_by_robust_updates():
    results = run("outliers", 20, 1.0)
    assert results["ekf"].anees.low > 3.0
    for label in ("gated", "huber", "student_t"):
        assert results[label].anees.value < results["ekf"].anees.value / 3
        assert rmse(results, "ekf")[0] > 1.5 * rmse(results, label)[0]


def test_a_coarse_bearing_is_mended_by_conversion_with_noise_from_the_prediction(monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    results = run("radar", 60, 40.0)
    assert results["converted"].verdict in ("consistent", "undecided")
    assert results["converted"].anees.value == pytest.approx(1.0, abs=0.25)
    assert results["from_reading"].anees.low > 2.0
    assert results["standard"].anees.low > 5.0
    assert (rmse(results, "standard") > 1.2 * rmse(results, "converted")).all()


def test_a_range_finder_without_a_return_gives_no_reading():
    """Fused as -1 m, such a reading gave NEES/n = 362. Near the edge the error has little bias.

    Over 30 runs the mean of the error towards the outside, in σ, has a standard deviation of about
    0.15 within 1 σ of the edge: a bound of 0.6 has a false-alarm rate of 1e-4.
    """
    results = run("rangefinder", 30, 2.0)
    for label in ("ekf", "ukf"):
        assert results[label].verdict in ("consistent", "undecided")
        assert results[label].anis.value == pytest.approx(1.0, abs=0.1)
    scenario = experiment.resolve(
        EXAMPLES / "rangefinder.toml", ["ekf"], runs=30, duration=2.0
    )  # fmt: skip
    ((_, traces),) = traced(setup.build(scenario), range(30))
    assert set(np.unique(traces.dof)) == {1, 2}
    tilt, error, std = traces.mean[1:, :, 0], traces.error[1:, :, 0], traces.std[1:, :, 0]
    distance = (np.arctan(0.3 / 1.95) - np.abs(tilt)) / std
    outward = np.sign(tilt) * error / std
    near = np.abs(distance) < 1.0
    assert near.sum() > 100
    assert abs(outward[near].mean()) < 0.6
    assert (outward[near] ** 2).mean() < 1.6
    assert (traces.dof[distance > 3.0] == 2).mean() > 0.99
    assert (traces.dof[distance < -3.0] == 1).mean() > 0.99


def test_a_filter_of_ones_own_from_the_command_line(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(EXAMPLES.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    words = ["run", "pendulum", "-e", "ekf", "-e", "examples.my_filter:MyFilter", "--runs", "2",
             "--duration", "0.2", "--out", str(tmp_path / "out"),
             "--json"]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["estbench", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert not exit_.value.code
    assert '"MyFilter"' in capsys.readouterr().out


def test_ones_own_filter_settles_at_the_ekf(monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    results = experiment.run(
        "pendulum", ["ekf", "examples.my_filter:MyFilter"], runs=10, duration=2.0,
        overrides=["consistency.burn_in=1"],
    )  # fmt: skip
    np.testing.assert_allclose(rmse(results, "MyFilter"), rmse(results, "ekf"), rtol=0.15)
    assert results["MyFilter"].anees.value == pytest.approx(results["ekf"].anees.value, rel=0.15)


def test_ones_own_filter_takes_settings_and_missing_readings(monkeypatch):
    monkeypatch.chdir(EXAMPLES.parent)
    monkeypatch.setattr(sys, "path", [*sys.path])
    results = experiment.run(
        "pendulum", ["mine"], runs=4, duration=0.5,
        overrides=['estimators.mine={type="examples.my_filter:MyFilter", scale=4.0}',
                   "channels.encoder.dropout=0.3", "channels.gyro.rate=50"],
    )  # fmt: skip
    assert results["mine"].diverged == 0


def test_a_falling_body_is_followed_nearly_as_well_as_it_could_be(monkeypatch, capsys):
    """The bound holds for each filter, within 4 standard errors of an RMSE of 300 runs."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    how_good = importlib.import_module("how_good")
    found = how_good.main()
    assert "height, m: bound     EKF     UKF" in capsys.readouterr().out
    assert found["bound"].shape == (how_good.STEPS + 1, 3)
    for name in ("ekf", "ukf"):
        ratio = found[name] / found["bound"]
        assert ratio.min() > 1 - 4 / np.sqrt(2 * how_good.RUNS)
        assert ratio[-1, 0] < 1.3


def test_rotated_points_see_the_floor_that_those_on_fixed_axes_miss(monkeypatch, tmp_path):
    """No fixed point is below the floor, so its mean lacks E max(h, floor) - E h."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    rotated_points = importlib.import_module("rotated_points")
    fixed, rotated = rotated_points.errors()
    assert fixed == pytest.approx(-rotated_points.EXACT, rel=1e-12)
    assert np.abs(rotated).max() < -fixed / 4
    assert abs(rotated.mean()) < 4 * rotated.std() / np.sqrt(rotated_points.STEPS)
    rotated_points.main(str(tmp_path / "contact.png"))
    assert (tmp_path / "contact.png").stat().st_size > 1e4


def test_a_learned_estimator_plugs_in(monkeypatch, tmp_path):
    """With a network of zeros it is the last readings and their mean rate over the window."""
    monkeypatch.syspath_prepend(EXAMPLES)
    learned = importlib.import_module("learned_velocity")
    window = np.zeros((2, learned.WINDOW, 3))
    window[1, :, 0] = 0.02 * np.arange(learned.WINDOW)  # 2 m/s
    np.testing.assert_allclose(learned.guess(window)[1], [0.3, 0.0, 2.0, 0.0])
    size = learned.features(window).shape[1]
    layers = np.zeros((8, size)), np.zeros(8), np.zeros((4, 8)), np.zeros(4)
    np.savez(
        tmp_path / "zero.npz",
        factor=np.diag([0.01, 0.01, 0.2, 0.2]),
        **{f"a{i}": layer for i, layer in enumerate(layers)},
    )
    results = experiment.run(
        "cartpole", ["learned"], runs=10, duration=1.0,
        overrides=['estimators.learned.type="learned_velocity:LearnedVelocity"',
                   f'estimators.learned.weights="{tmp_path / "zero.npz"}"',
                   "consistency.burn_in=0.2"],
    )  # fmt: skip
    # R of the encoders, and the mean rate is late by half a window.
    assert rmse(results, "learned")[:2] == pytest.approx(0.01, rel=0.6)
    assert (rmse(results, "learned")[2:] < 0.5).all()


def test_a_learned_estimator_is_trained(monkeypatch, tmp_path):
    pytest.importorskip("torch", reason="the example needs torch")
    monkeypatch.syspath_prepend(EXAMPLES)
    learned = importlib.import_module("learned_velocity")
    scenario = experiment.resolve("cartpole", runs=4, duration=1.0)
    (tmp_path / "short.toml").write_text(scenario.to_toml())
    files = learned.export(tmp_path / "short.toml", tmp_path / "logs")
    layers, factor = learned.train(files, 2)
    assert len(layers) == 4
    assert (np.diag(factor) > 0).all()


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_trackers_get_progress_and_results(name, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    trackers = importlib.import_module("trackers")
    logged = {}

    class Fake:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def init(self, **_):
            return self

        def start_run(self, **_):
            return self

        def log_params(self, params):
            logged.update(params)

        def log_metric(self, key, value):
            logged[key] = value

        def log(self, values):
            logged.update(values)

        log_metrics = log

    monkeypatch.setitem(sys.modules, name, Fake())
    results = getattr(trackers, f"with_{name}")("pendulum", estimators=["ekf"], runs=3,
                                                duration=0.1)  # fmt: skip
    assert logged["runs"] == 3
    assert logged["ekf/anees"] == pytest.approx(results.records["ekf"]["anees"].mean())
    assert "ekf/rmse_hinge.vel" in logged
