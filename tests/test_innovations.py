"""A store that keeps everything: ν and S of every update, also where readings miss or come late."""

import numpy as np
import pytest

import estbench
from estbench import experiment, setup
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


def test_listening_changes_no_number():
    prepared = setup.build(experiment.resolve("cartpole", ["ekf"], runs=3, duration=0.2))
    plain, full = (experiment.run_batch(prepared, range(3), k) for k in ("diagonal", "full"))
    for name, value in plain.records["ekf"].items():
        if name != "cpu_time":
            np.testing.assert_array_equal(value, full.records["ekf"][name])


def test_the_names_of_readings_and_of_the_class():
    spaces = {"a": Manifold.euclidean(1), "b": Manifold.euclidean(2, ["x", "y"])}
    assert readings(spaces) == ("a", "b.x", "b.y")
    prepared = setup.build(experiment.resolve("pendulum", ["ekf"], runs=1, duration=0.1))
    heard = listen(prepared.estimator("ekf"), prepared.channel_spaces, [0.1], 1)
    assert type(heard).__name__ == "EKF"
    assert not hasattr(heard, "smooth")
