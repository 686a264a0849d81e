import shutil
import threading
from collections import namedtuple

import numpy as np
import pytest

import estbench
from estbench.consistency import records
from estbench.errors import (
    ControllerError,
    EstbenchError,
    EstimatorError,
    ScenarioError,
    StoreError,
)
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.montecarlo import batch as batches
from estbench.montecarlo import executors, worker
from estbench.scenario.load import resolve
from tests.inference.test_event_loop import Plain

# Wall-clock time is the one thing that may differ.
COMPARED = sorted(records.SUMMARY)
FAST = {"duration": 0.3, "runs": 24, "batch_size": 6}


def run(scenario="cartpole", estimators=("ekf",), **options):
    return estbench.run(scenario, estimators, **{**FAST, **options})


def assert_same(a, b, rtol=0.0, fields=COMPARED):
    assert a.keys() == b.keys()
    for label in a:
        for name in fields:
            # Sums of products of either sign are as exact as their terms are large: as lag 0 is.
            atol = rtol * (np.abs(b[label][name]).max() if name == "lags" else 1.0)
            np.testing.assert_allclose(
                a[label][name], b[label][name], rtol=rtol, atol=atol, err_msg=f"{label} {name}"
            )


# The same numbers, whatever the machine


@pytest.mark.parametrize(
    ("scenario", "overrides"),
    [
        ("cartpole", []),
        ("cartpole", ["control.observe=estimate"]),
        ("cartpole", ["control.observe=truth"]),
        ("acrobot", ["truth.draw={'body_mass.lower'={relative_std=0.1}}", "model.frame_skip=2"]),
    ],
)
def test_a_seed_gives_the_same_bits_at_any_thread_count(scenario, overrides):
    one, two = (
        run(scenario, ["ekf", "ukf"], workers=threads, overrides=overrides) for threads in (1, 2)
    )
    assert_same(one.records, two.records)
    other = run(scenario, ["ekf", "ukf"], seed=1, overrides=overrides)
    assert (other.records["ekf"]["anees"] != one.records["ekf"]["anees"]).all()


@pytest.mark.parametrize("overrides", [[], ["control.observe=truth"], ["control.observe=estimate"]])
def test_batches_do_not_change_the_runs(overrides):
    """The bound is an expectation over a batch: here, where F varies little, nearly the same."""
    per_run = [f for f in COMPARED if records.SUMMARY[f].dims[0] == "run" and f != "bound"]
    whole = run(estimators=["ekf", "ukf"], batch_size=24, overrides=overrides)
    for size in (1, 7):
        some = run(estimators=["ekf", "ukf"], batch_size=size, overrides=overrides)
        assert_same(some.records, whole.records, 1e-9, per_run)
        for label, record in some.records.items():
            np.testing.assert_allclose(record["bound"], whole.records[label]["bound"], rtol=1e-3)
        assert some.runs == whole.runs == tuple(range(24))


def test_more_runs_do_not_change_the_first():
    few, many = run(runs=12), run(runs=24)
    for name in ("anees", "mse"):
        np.testing.assert_array_equal(few.records["ekf"][name], many.records["ekf"][name][:12])


def test_adding_an_estimator_changes_nothing_for_the_others():
    alone = run(estimators=["ekf"])
    both = run(estimators=["ukf", "ekf"])
    assert_same(alone.records, {"ekf": both.records["ekf"]})
    live = ["control.observe=estimate"]
    alone, both = (run(estimators=e, overrides=live) for e in (["ekf"], ["ukf", "ekf"]))
    assert_same(alone.records, {"ekf": both.records["ekf"]})


class InPlace(Plain):
    """Overwrites whatever it is given."""

    def init(self, mean, cov):
        mean *= 0.5
        cov *= 2.0
        return super().init(mean, cov)

    def update(self, belief, y, u, t, channels=None, mask=None):
        y += 1.0
        return super().update(belief, y, u, t, channels)


def test_an_estimator_that_overwrites_its_arguments_is_named():
    with pytest.raises(EstimatorError, match="InPlace: init changes an array that it is given"):
        run(estimators=[f"{__name__}:InPlace", "ekf"])


def test_a_saved_scenario_gives_identical_numbers(tmp_path):
    overrides = ["filter.process_noise_scale=0.5", "channels.pole_encoder.rate=50"]
    first = run(estimators=["ukf", "ekf"], out=tmp_path / "a", seed=3, overrides=overrides)
    again = estbench.run(tmp_path / "a", out=tmp_path / "b", batch_size=6)
    assert_same(first.records, again.records)
    texts = [(tmp_path / name / "scenario.toml").read_text() for name in "ab"]
    assert texts[0] == texts[1]
    with estbench.open_results(tmp_path / "a") as a, estbench.open_results(tmp_path / "b") as b:
        for group in ("truth", "ekf"):
            assert (
                a[group]
                .to_dataset()
                .drop_vars("cpu_time", errors="ignore")
                .identical(b[group].to_dataset().drop_vars("cpu_time", errors="ignore"))
            )


SEEN = []


class Keyed(EKF):
    """Notes the random keys that it is given."""

    def init(self, mean, cov, keys):
        SEEN.append(keys.tolist())
        return super().init(mean, cov)


def test_random_keys_belong_to_the_run_and_the_label():
    seen = []
    for label, size in (("a", 4), ("b", 4), ("b", 2)):
        SEEN.clear()
        one = f"estimators={{{label}={{type='{__name__}:Keyed'}}}}"
        run(estimators=None, overrides=[one], runs=4, batch_size=size, workers=1)
        seen.append(SEEN[-(4 // size) :])  # those before are of the trial of the estimator
    (a,), (b,), (first, second) = seen
    assert first + second == b
    assert len({*a, *b}) == 8


# Verdicts


@pytest.mark.parametrize("scenario", ["pendulum", "cartpole"])
@pytest.mark.parametrize(
    ("scale", "verdict"), [(1.0, "consistent"), (0.01, "overconfident"), (100.0, "conservative")]
)
def test_verdict_of_a_matched_and_of_a_mistuned_filter(scenario, scale, verdict):
    results = estbench.run(
        scenario,
        ["ekf", "ukf"],
        runs=100,
        duration=1.0,
        overrides=[f"filter.process_noise_scale={scale}"],
    )
    for summary in results.summaries:
        assert str(summary.verdict) == verdict
        assert summary.diverged == 0
        if scale == 1.0:
            assert 0.9 < summary.anees.value < 1.1
            assert 0.95 < summary.anis.value < 1.05
            assert abs(summary.lag_one.value) < 0.05


def test_wrong_measurement_noise_is_seen_too():
    for scale, verdict in ((0.1, "overconfident"), (10, "conservative")):
        overrides = [f"filter.measurement_noise_scale={scale}"]
        results = run(runs=60, batch_size=30, duration=1.0, overrides=overrides)
        assert str(results["ekf"].verdict) == verdict


def test_a_filter_of_the_wrong_mass_does_worse():
    wrong, right = (
        run(runs=60, batch_size=30, duration=1.0, overrides=overrides)["ekf"]
        for overrides in (['filter.set."body_mass.pole"=1.0'], [])
    )
    assert wrong.anees.low > right.anees.high
    assert wrong.rmse[3].value > right.rmse[3].value


def test_feedback_from_the_estimate_balances_the_pole():
    truth, estimate = (
        run(runs=20, batch_size=10, duration=2.0, overrides=[f"control.observe={who}"])
        for who in ("truth", "estimate")
    )
    assert str(estimate["ekf"].verdict) in ("consistent", "undecided")
    assert 1.0 in estimate["ekf"].anees
    assert (estimate.records["ekf"]["anees"] != truth.records["ekf"]["anees"]).all()
    assert not estimate.records["ekf"]["diverged"].any()


def test_with_feedback_from_the_estimate_each_estimator_has_its_own_truth(tmp_path):
    live = ["control.observe=estimate"]
    run(estimators=[f"{__name__}:Frozen", "ekf"], overrides=live, out=tmp_path / "x")
    with estbench.open_results(tmp_path / "x") as tree:
        assert "truth" not in tree.children
        for label in ("ekf", "Frozen"):
            x = tree[label]["x"].to_numpy()
            error = x - tree[label]["estimate"].to_numpy()
            np.testing.assert_allclose(tree[label]["error"], error, atol=1e-12, err_msg=label)


class Frozen(EKF):
    """Never looks at a measurement's value."""

    def update(self, belief, y, u, t, channels=None, mask=None):
        prediction = self.model.measurement(belief.mean, u, t, channels)
        return super().update(belief, prediction, u, t, channels, mask)


# Interruption


def test_ctrl_c_keeps_the_finished_runs(tmp_path):
    calls, kept = [], set(threading.enumerate())  # workers of processes are kept by design

    def progress(done, total):
        calls.append((done, total))
        if len(calls) == 2:
            raise KeyboardInterrupt

    cut = run(out=tmp_path / "cut", progress=progress, workers=1)
    assert calls == [(6, 24), (12, 24)]
    assert cut.interrupted
    # The worker may have finished one batch more before it heard of it; that is kept too.
    assert len(cut.runs) == cut["ekf"].runs
    assert len(cut.runs) in (12, 18)
    whole = run(out=tmp_path / "whole")
    assert not whole.interrupted
    runs = list(cut.runs)
    for name in ("anees", "mse"):
        np.testing.assert_array_equal(cut.records["ekf"][name], whole.records["ekf"][name][runs])
    with (
        estbench.open_results(tmp_path / "cut") as a,
        estbench.open_results(tmp_path / "whole") as b,
    ):
        stored = np.flatnonzero(a["done"].to_numpy())  # a worker may have finished another batch
        assert set(runs) <= set(stored.tolist())
        assert b["done"].to_numpy().all()
        for group, name in (("ekf", "error"), ("truth", "x")):
            np.testing.assert_array_equal(a[group][name][stored], b[group][name][stored])
    assert f"interrupted: {len(cut.runs)} of 24 runs" in str(cut)
    assert cut.to_dict()["interrupted"] is True
    started = set(threading.enumerate()) - kept
    assert not [t for t in started if t.name.startswith("estbench")]


def test_ctrl_c_before_the_first_batch_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(worker, "run_batch", interrupt)
    with pytest.raises(EstbenchError, match="interrupted before the first batch"):
        run(out=tmp_path / "new" / "x")
    assert list(tmp_path.iterdir()) == []


def fails_late(t, x):
    if t > 0.1:
        raise RuntimeError("no power")
    return 0.0


def test_a_failed_batch_leaves_no_folder(tmp_path):
    overrides = ["control.kind=user", f"control.function={__name__}:fails_late"]
    with pytest.raises(ControllerError, match="no power"):
        run(out=tmp_path / "x", overrides=overrides)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_to_the_end():
    calls = []
    run(progress=lambda *c: calls.append(c), batch_size=10, workers=1)
    assert calls == [(10, 24), (20, 24), (24, 24)]


# What is run


def test_arguments_replace_the_scenarios():
    resolved = resolve("cartpole", ["ukf"], 7, 8, 0.5, ["simulation.runs=9"])
    assert (resolved.simulation.runs, resolved.simulation.seed) == (9, 8)  # --set wins
    assert resolved.simulation.duration == 0.5
    assert resolved.estimators == {"ukf": {}}
    assert resolve(resolved, runs=3).simulation.runs == 3


def test_an_estimator_keeps_the_settings_of_its_label():
    overrides = ["estimators={tight={type='ukf', alpha=0.5}, ekf={}}"]
    resolved = resolve("cartpole", ["tight"], overrides=overrides)
    assert resolved.estimators == {"tight": {"type": "ukf", "alpha": 0.5}}
    user = resolve("cartpole", [f"{__name__}:Frozen"])
    assert user.estimators == {"Frozen": {"type": f"{__name__}:Frozen"}}


@pytest.mark.parametrize(
    ("estimators", "error", "message"),
    [
        (["efk"], EstimatorError, r"no estimator 'efk' \(did you mean 'ekf'"),
        (["ekf", "ekf"], EstimatorError, "'ekf' is named twice"),
        (["no.such:Thing"], EstimatorError, r"cannot import 'no\.such'"),
        ([f"{__name__}:Nothing"], EstimatorError, "has no 'Nothing'"),
        ([f"{__name__}:fails_late"], EstimatorError, r"lacks the method\(s\) init, predict"),
    ],
)
def test_bad_estimators(estimators, error, message):
    with pytest.raises(error, match=message):
        run(estimators=estimators)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("estimators={truth={type='ekf'}}", "label 'truth' is taken"),
        ("estimators={time={type='ekf'}}", "label 'time' cannot name a group"),
        ('estimators={"a/b"={type="ekf"}}', "label 'a/b' cannot name a group"),
        ('estimators={""={type="ekf"}}', "label '' cannot name a group"),
        ("consistency.burn_in=0.3", r"burn_in is 0\.3 s, which leaves nothing of a run of 0\.3 s"),
        ("model.keyframe=upsidedown", "no keyframe 'upsidedown'"),
        ("initial.std=[0.1, 0.1]", r"initial\.std has 2 values; expected 1 or 4"),
        ("filter.timestep=0.003", r"filter\.timestep: .* not a multiple"),
        ("filter.path=estbench:assets/acrobot/acrobot.xml", r"filter\.path: states shoulder"),
    ],
)
def test_scenarios_that_do_not_fit(override, message):
    with pytest.raises(EstbenchError, match=message):
        estbench.run("cartpole", duration=0.3, overrides=[override])


@pytest.mark.parametrize("timestep", [0, -0.01])
def test_an_mjcf_without_a_timestep(timestep, tmp_path):
    (tmp_path / "robot.xml").write_text(
        f"""<mujoco><option timestep="{timestep}"/><worldbody><body><joint name="j"/>
        <geom size="0.1"/></body></worldbody><sensor><jointpos joint="j"/></sensor></mujoco>"""
    )
    with pytest.raises(ScenarioError, match=r"model\.timestep is .*; use one above 0"):
        run(tmp_path / "robot.xml")


def test_default_batches_do_not_depend_on_the_machine(monkeypatch):
    def size(keep="summary", **options):
        return batches.default_batch_size(setup.build(resolve("cartpole", **options)), keep)

    assert size(runs=10_000) == 250
    assert size(runs=200) == 50
    assert size(runs=8) == 10
    assert size("full", runs=10_000, duration=500.0) < size(runs=10_000, duration=500.0) < 250
    before = size(runs=500)
    monkeypatch.setattr(executors, "cpu_count", lambda: 64)
    assert size(runs=500) == before


# What is kept


def test_traces_are_kept_while_they_are_small(tmp_path, monkeypatch):
    prepared = setup.build(resolve("cartpole", ["ekf", "ukf"], runs=24, duration=0.3))
    assert batches.default_keep(prepared) == "diagonal"
    for keep, kept in (("full", records.DIAGONAL | records.FULL), ("diagonal", records.DIAGONAL)):
        run(out=tmp_path / keep, estimators=["ekf", "ukf"], keep=keep)
        with estbench.open_results(tmp_path / keep) as tree:
            tree = tree.load()
            groups = [tree[g].data_vars for g in ("ekf", "ukf", "truth")]
            stored = sum(g[n].nbytes for g in groups for n in (*kept, "x") if n in g)
        assert batches.trace_bytes(prepared, keep=keep) == stored
    disk = namedtuple("Disk", "free")(stored // 2 - 1)
    with monkeypatch.context() as full:
        full.setattr(shutil, "disk_usage", lambda _: disk)
        with pytest.raises(StoreError, match=r"keep is 'diagonal': the traces .* --keep summary"):
            run(out=tmp_path / "no" / "room", estimators=["ekf", "ukf"])
    assert not (tmp_path / "no").exists()
    monkeypatch.setattr(batches, "TRACES_BYTES", stored - 1)
    assert batches.default_keep(prepared, "float32") == "diagonal"
    large = run(out=tmp_path / "large", estimators=["ekf", "ukf"])
    with estbench.open_results(tmp_path / "large") as tree:
        assert set(tree["ekf"].data_vars) == set(records.SUMMARY)
    assert any("only averages are stored; --keep diagonal" in n for n in large.notices)
    asked = run(out=tmp_path / "asked", estimators=["ekf", "ukf"], keep="diagonal")
    assert not asked.notices
    assert_same(large.records, asked.records)
    again = run(out=tmp_path / "asked", estimators=["ekf", "ukf"], resume=True)
    assert again["ekf"].anees == asked["ekf"].anees


def test_the_header_counts_control_steps_and_instants():
    even = estbench.run("cartpole", ["ekf"], runs=2, duration=0.2)
    assert str(even).startswith("cartpole: 2 runs x 0.2 s (20 steps), seed 0\n")
    # Control every 2 physics steps, a reading every 5: 10 steps, and 2 readings between them.
    changes = ["model.frame_skip=2", "channels.pole_encoder.rate=20"]
    changes += ['sensors=["pole_encoder"]']
    mixed = estbench.run("cartpole", ["ekf"], runs=2, duration=0.2, overrides=changes)
    assert str(mixed).startswith("cartpole: 2 runs x 0.2 s (10 steps, 12 instants), seed 0\n")
