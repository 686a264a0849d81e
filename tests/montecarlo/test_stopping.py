"""Runs are added until they are enough, and then are those of an experiment of that many."""

import numpy as np
import pytest

import estbench
from estbench.consistency.scores import score
from estbench.errors import EstimatorError, ExecutorError, ScenarioError
from estbench.experiment.setup import build
from estbench.montecarlo import pool, worker
from estbench.montecarlo.stopping import looks, rule
from estbench.scenario.load import resolve
from tests.stores import run, same

SHORT = {"duration": 0.3, "batch_size": 5}
STORED = {"duration": 0.3, "batch_size": 10, "keep": "summary"}


def test_looks_are_at_whole_batches_and_grow():
    assert list(looks(50, 400)) == [50, 100, 150, 200, 250, 350, 400]
    assert list(looks(50, 30)) == [30]
    assert list(looks(10, 45, begun=25)) == [30, 40, 45]
    many = np.array(list(looks(50, 100_000)))
    assert (many[1:-1] >= 1.25 * many[:-2]).all()
    assert len(many) < 40


def test_runs_are_added_until_the_interval_is_narrow(tmp_path):
    seen = []
    found = run(
        tmp_path / "x", runs=60, precision=0.3, progress=lambda *n: seen.append(n), **STORED
    )
    count = len(found.runs)
    assert 10 < count < 60
    assert seen[-1] == (count, 60)
    half = (found["ekf"].anees.high - found["ekf"].anees.low) / 2
    assert half <= 0.3
    assert f"stopped after {count} of at most 60 runs: NEES/n of ekf ± {half:.2g}" in found.notices
    assert found.scenario.simulation.runs == count
    at_once = run(tmp_path / "y", runs=count, **STORED)
    assert at_once["ekf"].anees == found["ekf"].anees
    same(tmp_path / "x", tmp_path / "y")
    # It goes on where it ended, and stops at once if what is there is enough.
    again = run(tmp_path / "x", runs=60, precision=0.3, resume=True, **STORED)
    assert again.runs == found.runs
    more = run(tmp_path / "x", runs=60, precision=0.2, resume=True, **STORED)
    assert more.runs[:count] == found.runs
    assert len(more.runs) > count


def test_a_worker_builds_the_experiment_once_for_all_looks(tmp_path, monkeypatch):
    def added(folder):
        run(tmp_path / folder, runs=30, precision=0.01, workers=1, **STORED)
        return len(built)

    built = []
    monkeypatch.setattr(worker, "build", lambda scenario: built.append(scenario) or build(scenario))
    assert added("here") == 0  # a thread has what `run` has built
    monkeypatch.setattr(pool._Here, "__call__", lambda here, task: here.function(task))
    assert added("elsewhere") == 1  # another process, in which a task is all there is
    same(tmp_path / "here", tmp_path / "elsewhere")


def test_the_precision_may_be_that_of_two_estimators():
    options = {"estimators": ["ekf", "const"], "runs": 40, **SHORT}
    options["overrides"] = ["estimators={ekf={}, const={type='ekf'}}",
                            "estimators.const.filter.process_noise_scale=100"]  # fmt: skip
    options["estimators"] = None
    found = run(None, precision=0.05, precision_of=("ekf", "const"), **options)
    a, b = (score(r["mse"], r["diverged"].astype(bool)) for r in found.records.values())
    half = 1.96 * (a - b).std(ddof=1) / np.sqrt(len(a))
    assert half < 0.05  # a little less than that of Student's t
    assert f"RMSE of ekf / const ± {half:.1g}"[:-1] in " ".join(found.notices)


def test_runs_are_added_until_no_verdict_is_undecided():
    wrong = ["filter.process_noise_scale=1e-3"]  # far too small: refuted by few runs
    found = run(None, runs=100, until_decided=True, overrides=wrong, **SHORT)
    assert found["ekf"].verdict in ("biased", "overconfident")
    assert len(found.runs) < 100
    assert f"{len(found.runs)} of at most 100 runs were needed to decide" in found.notices
    found = run(None, runs=10, seed=1, until_decided=True, **SHORT)
    assert found["ekf"].verdict == "undecided"
    assert "all 10 runs do not decide" in found.notices


def test_what_is_not_reached_is_said():
    found = run(None, runs=10, precision=0.01, **SHORT)
    said = found.notices[-1]
    assert said.startswith("all 10 runs do not give ± 0.01: NEES/n of ekf ±")
    needed = int(said.split("some ")[1].split(" runs")[0])
    values = found.records["ekf"]["anees"]
    assert needed == pytest.approx((1.96 * values.std(ddof=1) / 0.01) ** 2, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0.0, None, False), ScenarioError, "precision is 0.0; use a positive half-width"),
        ((np.nan, None, False), ScenarioError, "precision is nan"),
        ((None, ("ekf", "ukf"), False), ScenarioError, "without a precision"),
        ((0.1, ("ekf",), False), EstimatorError, "labels of two estimators"),
        ((0.1, ("ekf", "ekf"), False), EstimatorError, "labels of two estimators"),
        ((0.1, 3, False), EstimatorError, "precision_of is 3; use the labels"),
        (("0.1", None, False), ScenarioError, "precision is '0.1'; use a positive"),
        ((None, None, "no"), ScenarioError, "until_decided is 'no'; use True or False"),
        ((0.1, ("ekf", "ufk"), False), EstimatorError, r"'ufk', which is not run \(did you mean"),
    ],
)
def test_a_rule_that_is_none(arguments, error, message):
    with pytest.raises(error, match=message):
        rule(*arguments, resolve("pendulum", ["ekf", "ukf"]))


def test_nothing_is_decided_with_tolerance_0():
    exact = resolve("pendulum", ["ekf"], overrides=["consistency.tolerance=0"])
    with pytest.raises(ScenarioError, match=r"no end with consistency\.tolerance 0"):
        rule(None, None, True, exact)
    assert rule(0.1, None, False, exact) is not None


def test_a_share_cannot_tell_whether_runs_are_enough(tmp_path):
    assert rule(None, None, False, resolve("pendulum")) is None
    with pytest.raises(ExecutorError, match="a share of the runs cannot tell"):
        estbench.run("pendulum", "ekf", runs=9, precision=0.1, shard=(1, 2), out=tmp_path / "x")
