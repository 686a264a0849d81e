"""Logs with truth: interpolation, frames, its own noise, and the errors of poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estbench.errors import LogError
from estbench.logs import files
from estbench.logs.export import export
from estbench.logs.frames import Rigid, fitted
from estbench.logs.replay import replay
from estbench.logs.results import render, to_dict
from estbench.logs.trajectory import Poses, errors, write_tum
from estbench.logs.truth import at_times, parts
from estbench.scenario.load import load, resolve
from estbench.scenario.log import LogSection, TruthSection
from estbench.spaces import rotation
from estbench.spaces.manifold import Manifold
from estbench.tables import writers

AXES = ("x", "y", "z")
FREE = Manifold(
    tuple(f"root.{p}{a}" for p in ("", "r", "v", "w") for a in AXES),
    ("m",) * 3 + ("rad",) * 3 + ("m/s",) * 3 + ("rad/s",) * 3,
    np.array([[3, 3]]),
)


def quaternion(vectors):
    return rotation.exp(np.asarray(vectors, float))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A quadrotor's log of 0.4 s: the file of its run, and the scenario that replays it."""
    folder = tmp_path_factory.mktemp("truth")
    scenario = resolve("quadrotor", ["ekf"], runs=1, duration=0.4)
    (folder / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(folder / "scenario.toml", folder / "out")
    return file, load(folder / "out" / "scenario.toml")


def with_truth(scenario, **changes):
    truth = scenario.log.truth.model_copy(update=changes)
    return scenario.model_copy(update={"log": scenario.log.model_copy(update={"truth": truth})})


def test_interpolation_is_on_the_manifold_and_exact_at_the_stamps(tmp_path):
    turns = quaternion([[0, 0, 0.0], [0, 0, 1.0], [0, 0, 2.5]])
    table = np.column_stack([[0.0, 0.1, 0.3], turns * [[1], [-1], [1]], [1.0, 2.0, 4.0]])
    np.savetxt(tmp_path / "t.csv", table, delimiter=",", header="time,w,x,y,z,px", comments="")
    section = TruthSection.model_validate({
        "longest_gap": 0.15, "states": {"root.rotation": {"columns": list("wxyz")},
                                        "root.x": {"columns": ["px"], "noise": 0.01}},
    })  # fmt: skip
    log = LogSection(truth=section)
    found = parts(files.read_all([tmp_path / "t.csv"]), log, section, FREE, 0.0)
    truth = at_times(found, section, FREE, np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4]))
    assert rotation.log(truth.x[1, 3:7]) == pytest.approx([0, 0, 0.5])
    assert np.array_equal(truth.x[0, 3:7], turns[0])
    assert truth.x[1, 0] == pytest.approx(1.5)
    assert truth.noise[0] == 0.01
    # Beyond the longest gap, and after the end, nothing is known; at a stamp it is.
    assert truth.known[:, 3].tolist() == [True, True, True, False, True, False]
    assert not truth.known[:, 6:].any()


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ({"root.qw": {"columns": ["w"]}}, "a rotation needs its four numbers"),
        ({"roof": {"columns": ["px"]}}, "no such part.*'root'"),
        ({"root.rotation": {"columns": ["w"]}}, r"has 1 columns; the part has 4"),
        ({"root.x": {"columns": ["px"]}, "root.position": {"columns": ["px"] * 3}}, "mapped by"),
        ({}, "states is empty"),
    ],
)
def test_mistakes_are_one_line(tmp_path, states, message):
    np.savetxt(tmp_path / "t.csv", np.eye(2), delimiter=",", header="time,w", comments="")
    (tmp_path / "u.csv").write_text("time,px\n0,1\n1,2\n", encoding="utf-8")
    section = TruthSection.model_validate({"states": states})
    with pytest.raises(LogError, match=message):
        parts(files.read_all([tmp_path / "t.csv", tmp_path / "u.csv"]), LogSection(), section,
              FREE, 0.0)  # fmt: skip


def test_a_fitted_frame_is_the_true_one():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((20, 3))
    true = Rigid(quaternion([0.3, -2.0, 0.5]), np.array([1.0, 2.0, 3.0]))
    found = fitted(points, true.points(points))
    assert found.translation == pytest.approx(true.translation)
    assert found.points(points) == pytest.approx(true.points(points))
    with pytest.raises(LogError, match="on one line"):
        fitted(np.outer(np.arange(5), [1.0, 2, 3]), points[:5])


def test_the_truth_of_another_frame_gives_the_same_errors(flown, tmp_path):
    """The truth is turned and shifted; its inverse is given, or fitted to the estimates."""
    file, scenario = flown
    (table,) = files.read(file)
    columns = dict(table.columns)
    place = np.column_stack([columns[f"x.root.{a}"] for a in AXES])
    turn = np.column_stack([columns[f"x.root.q{a}"] for a in "wxyz"])
    speed = np.column_stack([columns[f"x.root.v{a}"] for a in AXES])
    away = Rigid(quaternion([0.0, 0.0, 0.7]), np.array([5.0, -1.0, 2.0]))
    back = Rigid(rotation.conjugate(away.rotation),
                 -away.translation @ rotation.matrix(away.rotation))  # fmt: skip
    for a, value in zip(AXES, away.points(place).T):
        columns[f"x.root.{a}"] = value
    for a, value in zip("wxyz", away.rotations(turn).T):
        columns[f"x.root.q{a}"] = value
    for a, value in zip(AXES, away.vectors(speed).T):
        columns[f"x.root.v{a}"] = value
    np.savez(tmp_path / "moved.npz", **columns)
    given = with_truth(scenario, frame="given", rotation=back.rotation.tolist(),
                       translation=back.translation.tolist())  # fmt: skip
    same = replay(scenario, file)["ekf"]
    found = replay(given, tmp_path / "moved.npz")["ekf"]
    assert found.traces.error == pytest.approx(same.traces.error, abs=1e-12)
    assert found.traces.nees == pytest.approx(same.traces.nees, rel=1e-6)
    free = replay(with_truth(scenario, frame="estimated"), tmp_path / "moved.npz")["ekf"]
    error = free.traces.error[:, 0, :3]
    assert np.abs(error.mean(axis=0)).max() < 1e-12  # the fit takes the mean away
    assert free.trajectories["root"].ate == pytest.approx(same.trajectories["root"].ate)


def test_the_noise_of_the_truth_counts(flown):
    file, scenario = flown
    states = {
        name: part.model_copy(update={"noise": 0.1}) if name in ("root.x", "root.y") else part
        for name, part in scenario.log.truth.states.items()
    }
    exact, noisy = (replay(s, file)["ekf"].traces
                    for s in (scenario, with_truth(scenario, states=states)))  # fmt: skip
    cov = exact.cov[50, 0] + np.diag([0.01, 0.01] + [0.0] * 10)
    e = exact.error[50, 0]
    assert noisy.nees[50, 0] == pytest.approx(e @ np.linalg.solve(cov, e))
    assert np.array_equal(noisy.std, exact.std)
    assert noisy.sigma[50, 0, 0] == pytest.approx(np.hypot(exact.std[50, 0, 0], 0.1))


def test_truth_of_some_coordinates(flown, tmp_path):
    file, scenario = flown
    states = {k: v for k, v in scenario.log.truth.states.items() if k[5:] in ("x", "y", "z")}
    found = replay(with_truth(scenario, states=states), file, out=tmp_path / "out")
    traces, summary = found["ekf"].traces, found["ekf"].summary
    assert traces.rank.max() == 3
    e, P = traces.error[40, 0, :3], traces.cov[40, 0, :3, :3]
    assert traces.nees[40, 0] == pytest.approx(e @ np.linalg.solve(P, e))
    assert np.isfinite([i.value for i in summary.rmse[:3]]).all()
    assert np.isnan([i.value for i in summary.rmse[3:]]).all()
    assert "no truth of root.rx" in " ".join(writers.printed(render(found), width=100).split())
    assert list(to_dict(found)["estimators"]["ekf"]["rmse"]) == ["root.x", "root.y", "root.z"]


def test_errors_of_poses_are_those_of_evo(tmp_path):
    """Of a noisy trajectory, by both files: `evo_ape --align` and `evo_rpe --all_pairs`."""
    rng = np.random.default_rng(4)
    t = np.arange(300) * 0.02
    place = np.column_stack([np.sin(t), np.cos(2 * t), 0.3 * t])
    turn = quaternion(np.column_stack([0.4 * np.sin(t), 0.2 * t, 0.5 * t]))
    reference = Poses(t, place, turn)
    shift = Rigid(quaternion([0.1, 0.2, -0.5]), np.array([1.0, 2.0, 0.5]))
    noisy = rotation.multiply(turn, quaternion(0.02 * rng.standard_normal((300, 3))))
    estimate = Poses(
        t, shift.points(place + 0.05 * rng.standard_normal((300, 3))), shift.rotations(noisy)
    )
    ours = errors(estimate, reference)
    assert (ours.frames, ours.poses) == (50, 300)
    # The definitions, by scipy.
    i = np.arange(250)
    R, S = (Rotation.from_quat(p.turn[:, [1, 2, 3, 0]]) for p in (reference, estimate))
    true = R[i].inv().apply(place[i + 50] - place[i])
    seen = S[i].inv().apply(estimate.position[i + 50] - estimate.position[i])
    assert ours.rpe == pytest.approx(np.sqrt(np.mean(np.sum((true - seen) ** 2, axis=1))))
    for name, poses in (("est.tum", estimate), ("ref.tum", reference)):
        write_tum(tmp_path / name, poses)
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed")
    from evo.tools import file_interface

    ref, est = (file_interface.read_tum_trajectory_file(str(tmp_path / f"{n}.tum"))
                for n in ("ref", "est"))  # fmt: skip

    def evo(metric):
        metric.process_data((ref, est))
        return metric.get_statistic(metrics.StatisticsType.rmse)

    part, angle = (metrics.PoseRelation.translation_part,
                   metrics.PoseRelation.rotation_angle_rad)  # fmt: skip
    for relation, value in ((part, ours.rpe), (angle, ours.rpe_turn)):
        theirs = evo(metrics.RPE(relation, 50, metrics.Unit.frames, all_pairs=True))
        assert theirs == pytest.approx(value, rel=1e-9)
    est.align(ref)
    for relation, value in ((part, ours.ate), (angle, ours.ate_turn)):
        assert evo(metrics.APE(relation)) == pytest.approx(value, rel=1e-9)
