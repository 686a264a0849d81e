import json

import numpy as np
import pytest

import estbench
from estbench.errors import StoreError, StudyError
from estbench.experiment.prepared import Setup
from estbench.scenario.load import load

Q, R = "filter.process_noise_scale", "filter.measurement_noise_scale"
SHORT = {"runs": 10, "duration": 0.2}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """The pendulum, Q started x 100 and R x 0.01, and how many runs were simulated."""
    counted, original = [], Setup.simulator

    def counting(self, runs):
        counted.append(len(runs))
        return original(self, runs)

    folder = tmp_path_factory.mktemp("tuned") / "a"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Setup, "simulator", counting)
        found = estbench.tune(
            "pendulum", "ekf", [Q, R], **SHORT, overrides=[f"{Q}=100", f"{R}=0.01"], out=folder
        )
    return found, counted, folder


def test_q_and_r_are_recovered_and_held_out_runs_agree(tuned):
    found, counted, _ = tuned
    assert sum(counted) == 20  # the tuning runs once, the held-out runs once
    for interval, std in zip(found.intervals, found.uncertainty.std):
        assert abs(np.log(interval.value)) < 4 * std
    assert abs(np.log(found[R])) < 0.3
    held = found.held_out
    assert held.likelihood.low > 0
    assert str(held.before.verdict) == "overconfident"
    assert held.before.anees.value > 20
    assert 0.4 < held.after.anees.value < 2.5
    assert not held.overfitted
    assert found.batches <= 40


def test_the_tuned_scenario_runs_and_is_the_tuned_filter(tuned):
    found, _, folder = tuned
    text = (folder / "tuned.toml").read_text()
    assert text.startswith("# ekf tuned by estbench: objective likelihood, search quasi-newton, 10")
    assert f"# {Q}: 100.0 -> {found[Q]}" in text
    again = estbench.run(load(folder / "tuned.toml"), seed=1)
    assert again["ekf"].anees == found.held_out.after.anees
    stored = json.loads((folder / "tuned.json").read_text())
    assert stored["parameters"][Q]["after"] == found[Q]
    assert stored["trace"][-1]["loss"] <= stored["trace"][0]["loss"]


def test_it_is_gone_on_with_without_a_new_candidate(tuned, monkeypatch):
    found, _, folder = tuned
    again = {"overrides": [f"{Q}=100", f"{R}=0.01"], "out": folder, "held_out": 0}
    with pytest.raises(StoreError, match="exists; choose another --out"):
        estbench.tune("pendulum", "ekf", [Q, R], **SHORT, **again)
    for free, options in (([Q, R], {"out": folder}), ([R, Q], again)):
        with pytest.raises(StoreError, match="is of another scenario or of other free keys"):
            estbench.tune("pendulum", "ekf", free, **SHORT, **options, resume=True)
    monkeypatch.setattr(Setup, "simulator", None)  # nothing is simulated
    same = estbench.tune("pendulum", "ekf", [Q, R], **SHORT, **again, resume=True)
    assert same.values == found.values
    assert same.candidates == found.candidates


def test_the_tables_name_what_was_done(tuned):
    text = str(tuned[0])
    assert "pendulum: ekf tuned by likelihood (quasi-newton), 10 runs, seed 0" in text
    assert "held-out: 10 runs, seed 1" in text
    assert "log-lik. change" in text.replace("\n", " ") or "change" in text


def test_q_of_each_coordinate_is_recovered_from_a_factor_of_100():
    free = [f'filter.process_noise.density."{axis}.vel"' for axis in ("cart", "pole")]
    found = estbench.tune(
        "cartpole", "ekf", free, runs=8, duration=1.0, held_out=0,
        overrides=[f"{key}=1.0" for key in free],
    )  # fmt: skip
    assert (found.uncertainty.std < 0.8).all()
    assert (np.abs(np.log(found.values) - np.log(0.01)) < 4 * found.uncertainty.std).all()


def test_a_squared_error_determines_the_ratio_of_q_and_r_only():
    found = estbench.tune(
        "pendulum", "ekf", [f"{Q}=0.05:20", f"{R}=0.05:20"], **SHORT, objective="mse", held_out=0,
        iterations=5, overrides=[f"{Q}=10", f"{R}=0.5"], coordinates={"hinge.vel": 1.0},
    )  # fmt: skip
    assert any("do not determine" in line or "end of its range" in line for line in found.words)
    assert found.loss[1] < found.loss[0] == pytest.approx(1.0)


def test_the_constraint_keeps_nees_within_the_tolerance():
    found = estbench.tune(
        "pendulum", "ekf", [Q, R], **SHORT, objective="consistent-mse", held_out=0, iterations=8,
        overrides=[f"{Q}=10", f"{R}=10", "consistency.tolerance=0.1"],
    )  # fmt: skip
    tuned = estbench.run(found.scenario)
    assert 1 / 1.1 - 1e-6 < tuned["ekf"].anees.value < 1.1 + 1e-6


def test_a_users_setting_is_tuned():
    name, short = "examples.my_filter:MyFilter", {"runs": 4, "duration": 0.3}
    found = estbench.tune(
        "pendulum", name, ["scale"], **short, held_out=0,
        overrides=["estimators.MyFilter.scale=1000.0"],
    )  # fmt: skip
    best, *others = (
        estbench.run("pendulum", name, **short, overrides=[f"estimators.MyFilter.scale={scale}"])
        for scale in (found["scale"], 1.3 * found["scale"], found["scale"] / 1.3, 1000.0)
    )
    for other in others:
        assert best["MyFilter"].log_likelihood.value > other["MyFilter"].log_likelihood.value


@pytest.mark.parametrize(
    ("free", "options", "message"),
    [
        ([Q, R], {"runs": 2}, "2 free parameters need at least 3 runs, got 2"),
        ([], {}, "nothing is free"),
        (["delays=exact,naive"], {"method": "quasi-newton"}, "no such setting|cannot search"),
        (
            [Q],
            {"method": "nelder-mead", "objective": "consistent-mse"},
            "which nelder-mead does not",
        ),
        ([Q], {"resume": True}, "resume needs the folder"),
        ([Q], {"objective": "mse", "coordinates": {"nose": 1.0}}, "'nose' matches none"),
    ],
)
def test_bad_input(free, options, message):
    with pytest.raises(estbench.EstbenchError, match=message):
        estbench.tune("pendulum", "ekf", free, **{**SHORT, "held_out": 0, **options})
    assert issubclass(StudyError, estbench.EstbenchError)


def test_readings_that_depend_on_the_candidate_have_no_likelihood_to_compare():
    with pytest.raises(StudyError, match="each candidate has readings of its own"):
        estbench.tune("cartpole", "ekf", [Q], **SHORT, overrides=["control.observe=estimate"])


def test_optuna_chooses(monkeypatch):
    pytest.importorskip("optuna")
    found = estbench.tune(
        "pendulum", "ekf", ["type=ekf,iekf", f"{Q}=0.01:100"], **SHORT, held_out=0, iterations=16,
        overrides=[f"{Q}=100"],
    )  # fmt: skip
    assert found.method == "optuna"
    assert found.loss[1] < found.loss[0]
    assert found["type"] in ("ekf", "iekf")
