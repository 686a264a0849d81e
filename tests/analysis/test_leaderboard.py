import csv
import io

import numpy as np
import pytest

import estbench
from estbench.analysis import board, leaderboard
from estbench.errors import AnalysisError, EstbenchError, StoreError
from estbench.estimators import names
from estbench.scenario.files import bundled

NAMES = ("ekf", "ukf", "kf", "ghkf", "pf")


@pytest.fixture(scope="module")
def boards():
    # 16 runs: the fewest that let three estimators be told apart, and some more.
    return [
        leaderboard.play("pendulum", 16, NAMES[:3], workers=2, duration=0.5),
        leaderboard.play("quadrotor", 4, NAMES, workers=2, duration=0.1),
    ]


def test_estimators_that_do_not_suit_are_skipped_with_a_reason(boards):
    assert not boards[0].skipped
    assert set(boards[1].skipped) == {"ghkf", "pf"}
    assert "12" in boards[1].skipped["pf"]
    assert {s.label for s in boards[1].results.summaries} == {"ekf", "ukf", "kf"}


def test_a_large_robot_has_its_own_estimators_only():
    """Fifteen filters of the whole dynamics of a walking biped take hours."""
    board = leaderboard.play("biped", 2, duration=0.05)
    assert set(board.skipped) == set(leaderboard.MAIN)
    assert board.skipped["ekf"] == "32 coordinates are too many for it"
    assert {s.label for s in board.results.summaries} == {"contact_ekf", "contact_inekf"}


def test_the_runs_are_those_of_estbench_run(boards):
    again = estbench.run("pendulum", ["ekf"], runs=16, duration=0.5)
    assert boards[0].results["ekf"].rmse == again["ekf"].rmse


def test_markdown_says_how_it_was_made(boards):
    text = board.markdown(boards)
    assert "estbench reproduce --runs 16" in text
    assert f"estbench {estbench.__version__}" in text
    assert "## pendulum: 16 runs x 0.5 s (50 steps), seed 0" in text
    assert "RMSE [rad]" in text
    assert "RMSE [m/s]" in text
    assert "- not `ghkf`: " in text
    assert "With 4 runs no two of 3 estimators can be told apart" in text
    lines = [line for line in text.split("\n") if line.startswith("| ")]
    assert len(lines) == 2 * (1 + 3) + 2
    # Both Gaussian filters tie; the linear one is far behind on a swinging pendulum.
    assert [line.split(" | ")[0] for line in lines[2:5]] == ["| 1=", "| 1=", "| 3"]


def test_csv_has_units_and_seeds(boards):
    rows = list(csv.DictReader(io.StringIO(board.to_csv(boards))))
    assert [(r["scenario"], r["estimator"]) for r in rows if r["estimator"] == "ekf"] == [
        ("pendulum", "ekf"),
        ("quadrotor", "ekf"),
    ]
    row = next(r for r in rows if r["estimator"] == "ekf")
    summary = boards[0].results["ekf"]
    assert float(row["rmse_rad"]) == pytest.approx(summary.rmse[0].value, rel=1e-5)
    assert float(row["rmse_rad_per_s_high"]) == pytest.approx(summary.rmse[1].high, rel=1e-5)
    assert row["rmse_m"] == ""
    assert (row["seed"], row["runs"], row["steps"]) == ("0", "16", "50")
    assert row["mujoco"]
    quadrotor = next(r for r in rows if r["scenario"] == "quadrotor" and r["estimator"] == "ekf")
    squares = [i.value**2 for i in boards[1].results["ekf"].rmse[:3]]
    assert float(quadrotor["rmse_m"]) == pytest.approx(np.sqrt(sum(squares)), rel=1e-5)


def test_files_are_written_and_come_out_the_same(tmp_path):
    said = []
    for name in ("one", "two"):
        leaderboard.reproduce(
            tmp_path / name, 3, ["pendulum"], ["kf", "ekf"], workers=2, say=said.append
        )
    assert said == ["pendulum: 3 runs"] * 2
    rows = [
        [
            {k: v for k, v in row.items() if not k.startswith("cost")}
            for row in csv.DictReader((tmp_path / name / "leaderboard.csv").open())
        ]
        for name in ("one", "two")
    ]
    assert rows[0] == rows[1]
    assert (tmp_path / "one/leaderboard.md").read_text().startswith("# Leaderboard")


def test_mistakes(tmp_path):
    with pytest.raises(AnalysisError, match="runs is 1"):
        leaderboard.reproduce(tmp_path, 1)
    with pytest.raises(EstbenchError, match="no scenario 'pendulm'"):
        leaderboard.reproduce(tmp_path, 2, ["pendulm"])
    with pytest.raises(AnalysisError, match="quadrotor: no estimator suits"):
        leaderboard.play("quadrotor", 2, ["ghkf"])
    (tmp_path / "file").write_text("")
    one = leaderboard.play("pendulum", 2, ["kf"], workers=1, duration=0.05)
    with pytest.raises(StoreError, match="cannot be written"):
        leaderboard.write([one], tmp_path / "file")


def test_an_interruption_writes_nothing(tmp_path, monkeypatch):
    results = estbench.run("pendulum", ["kf"], runs=2, duration=0.05)

    def interrupted(*arguments, **options):
        from dataclasses import replace

        return replace(results, interrupted=True)

    monkeypatch.setattr(leaderboard, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        leaderboard.reproduce(tmp_path / "out", 2, ["pendulum"], ["kf"])
    assert not (tmp_path / "out").exists()


def test_the_main_estimators_exist_and_so_do_their_robots():
    assert set(leaderboard.MAIN) <= set(names.known())
    assert {"ekf", "ukf"} <= set(leaderboard.MAIN)
    assert {"acrobot", "cartpole", "pendulum", "quadrotor"} <= set(leaderboard.robots())
    assert "cartpole_imu" in set(bundled()) - set(leaderboard.robots())
