from dataclasses import dataclass

import numpy as np
import pytest
import xarray

import estbench
from estbench.errors import EstimatorError, StoreError, StudyError
from estbench.experiment.prepared import Setup
from estbench.scenario.load import resolve
from estbench.study import axes
from estbench.study import run as running
from estbench.study.design import Study
from estbench.study.store import StudyStore, open_study, read_about

SHORT = {"runs": 6, "duration": 0.3}


def study(*over, estimators=("ekf",), robot="pendulum", overrides=(), **options):
    scenario = resolve(robot, list(estimators), **SHORT | options, overrides=list(overrides))
    return Study(scenario, axes.grid([axes.parse(text) for text in over]))


@pytest.fixture
def simulations(monkeypatch):
    """Counts the runs that are simulated."""
    counted = []
    original = Setup.simulator

    def counting(self, runs):
        counted.append(len(runs))
        return original(self, runs)

    monkeypatch.setattr(Setup, "simulator", counting)
    return counted


OVER = ("filter.process_noise_scale=0.1,1,10", "channels.gyro.noise=0.01,0.04")


def test_a_variant_is_the_run_with_that_setting_to_the_last_bit():
    found = running.run(study(*OVER, estimators=("ekf", "enkf")), batch_size=4)
    index = np.arange(6).reshape(3, 2)
    for i, q, j, r in ((0, 0.1, 1, 0.04), (2, 10, 0, 0.01)):
        alone = estbench.run(
            "pendulum", ["ekf", "enkf"], **SHORT,
            overrides=[f"filter.process_noise_scale={q}", f"channels.gyro.noise={r}"],
        )  # fmt: skip
        for label in ("ekf", "enkf"):
            record = found.records[index[i, j]][label]
            for name in ("anees", "mse", "log_likelihood", "lag_one", "nees_by_block"):
                np.testing.assert_array_equal(record[name], alone.records[label][name])


def test_truth_is_simulated_once_for_all_variants_of_the_filter(simulations):
    over = (
        OVER[0],
        "start.inflate=1,3",
        "filter.channels.gyro.noise=0.01,0.02",
        "consistency.burn_in=0,0.1",
    )
    found = running.run(study(*over))
    assert len(found.study.groups) == 1
    assert simulations == [6]
    simulations.clear()
    found = running.run(study(*OVER))
    assert [g.shape for g in found.study.groups] == [(3, 1), (3, 1)]
    assert simulations == [6, 6]


def test_a_store_has_the_keys_as_dimensions_and_is_gone_on_with(tmp_path, simulations):
    folder, made = tmp_path / "a", study(*OVER)
    whole = running.run(made, batch_size=2)
    running.run(made, out=folder, batch_size=2)
    tree = open_study(folder)
    assert tree["anees"].dims == (*(t.partition("=")[0] for t in OVER), "estimator", "run")
    np.testing.assert_array_equal(
        tree["mse"].values.reshape(6, 6, 2)[3], whole.records[3]["ekf"]["mse"]
    )
    assert tree["done"].values.all()
    # A writer that is killed leaves pieces that are not marked as done: here two of the six.
    about = read_about(folder)
    assert list(about["sizes"]) == sorted(about["sizes"])  # not in the order of a set
    store = StudyStore(folder, made, about["sizes"], about["batch_size"])
    for piece in ((0, 1), (1, 2)):
        store._arrays["done"][store._where(piece)] = False
    simulations.clear()
    again = running.run(made, out=folder, resume=True)
    assert simulations == [2, 2]
    costs = ["cost_us_per_run_step"]
    xarray.testing.assert_identical(
        again.dataset().drop_vars(costs).drop_attrs(deep=False),
        whole.dataset().drop_vars(costs).drop_attrs(deep=False),
    )


def test_a_store_takes_more_runs(tmp_path, simulations):
    few, folder = study(*OVER, runs=5), tmp_path / "a"
    running.run(few, out=folder, batch_size=2)
    simulations.clear()
    more = running.run(study(*OVER), out=folder, resume=True)
    assert simulations == [2, 2]  # in each group the batch that was a part of one
    whole = running.run(study(*OVER), out=tmp_path / "b", batch_size=2)
    xarray.testing.assert_identical(
        open_study(folder).drop_vars("cpu_time").load(),
        open_study(tmp_path / "b").drop_vars("cpu_time").load(),
    )
    assert more.runs == whole.runs == tuple(range(6))
    with pytest.raises(StoreError, match="is of another study"):
        running.run(few, out=folder, resume=True)


def test_shares_fill_one_store(tmp_path, simulations):
    made, folder = study(*OVER), tmp_path / "a"
    with pytest.raises(estbench.EstbenchError, match="the share 1/2 is finished"):
        running.run(made, out=folder, shard=(1, 2), batch_size=6)
    assert simulations == [6]
    assert running.run(made, out=folder, shard=(2, 2)).runs == tuple(range(6))
    assert simulations == [6, 6]


def test_another_study_or_an_existing_folder_is_refused(tmp_path):
    folder = tmp_path / "a"
    running.run(study(OVER[0]), out=folder)
    with pytest.raises(StoreError, match="exists; choose another --out"):
        running.run(study(OVER[0]), out=folder)
    with pytest.raises(StoreError, match="is of another study"):
        running.run(study(OVER[1]), out=folder, resume=True)
    with pytest.raises(StoreError, match=r"holds no study\.json"):
        open_study(tmp_path)


@dataclass(frozen=True)
class Fragile(estbench.EKF):
    """An EKF that raises in the middle of the run where its gain is negative."""

    gain: float = 1.0

    def update(self, belief, y, u, t, channels=None, mask=None):
        if self.gain < 0 and t > 0.1:
            raise ValueError("negative gain")
        return super().update(belief, y, u, t, channels, mask)


def test_a_variant_that_fails_is_named_and_the_others_go_on():
    made = study("estimators.Fragile.gain=1.0,-1.0", estimators=["ekf", f"{__name__}:Fragile"])
    found = running.run(made)
    assert list(found.failures) == [(1, "Fragile")]
    assert "negative gain" in found.failures[1, "Fragile"]
    verdicts = found.dataset().verdict.sel(estimator="Fragile").values
    assert verdicts[0] != "diverging" == verdicts[1]
    assert (found.dataset().verdict.sel(estimator="ekf") != "diverging").all()


@pytest.mark.parametrize(
    ("over", "error", "message"),
    [
        ("simulation.runs=2,4", StudyError, "not free to vary"),
        ("simulation.seed=2,4", StudyError, "not free to vary"),
        ("estimators.ukf.alpha=0.1,1", StudyError, "'ukf' is not run"),
        ("filter.nothing=1,2", StudyError, "unknown key"),
        ("filter.process_noise_scale=-1,1", StudyError, "greater than 0"),
        ("estimators.ekf.nothing=1,2", EstimatorError, "no setting 'nothing'"),
        ("filter.set.body_mass.rd=1,2", estbench.ScenarioError, "no body 'rd'"),
    ],
)
def test_mistakes_are_found_before_anything_is_simulated(over, error, message, simulations):
    with pytest.raises(error, match=message):
        running.run(study(over))
    assert not simulations


def test_an_estimator_has_its_own_filter_section():
    both = estbench.run(
        "pendulum", **SHORT,
        overrides=["estimators={ekf={}, own={type='ekf'}}",
                   "estimators.own.filter.process_noise_scale=0.1",
                   "estimators.own.filter.process_noise.density={'hinge.vel'=1e-3}",
                   "estimators.own.filter.channels.gyro.noise={x=0.05}"],
    )  # fmt: skip
    shared = ["filter.process_noise_scale=0.1", "filter.process_noise.density={'hinge.vel'=1e-3}",
              "filter.channels.gyro.noise={x=0.05}"]  # fmt: skip
    alone = estbench.run("pendulum", ["ekf"], **SHORT, overrides=shared)
    plain = estbench.run("pendulum", ["ekf"], **SHORT)
    np.testing.assert_array_equal(both.records["own"]["mse"], alone.records["ekf"]["mse"])
    np.testing.assert_array_equal(both.records["ekf"]["mse"], plain.records["ekf"]["mse"])
    assert (both.records["own"]["mse"] != both.records["ekf"]["mse"]).any()
