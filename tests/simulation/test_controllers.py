import re
from functools import cache

import mujoco
import numpy as np
import pytest

import estbench
from estbench.errors import ControllerError, DimensionError, ScenarioError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.robots import backend
from estbench.scenario.schema import ControlSection
from estbench.simulation import controllers, kinds
from tests.helpers import zoo_model


@cache
def plant(name):
    return setup.build(experiment.resolve(name)).plant


def build(name, runs=range(3), steps=50, seed=0, **section):
    return controllers.build(ControlSection(**section), plant(name), seed, runs, steps)


def states(name, runs=3):
    return np.broadcast_to(plant(name).x0, (runs, plant(name).x0.size))


# Beyond the ctrlrange: ±20 N of the cart-pole's force, 0 to 6 N of the quadrotor's rotors


@pytest.mark.parametrize(
    ("name", "section", "said"),
    [
        ("cartpole", {"kind": "constant", "value": 20.0}, []),
        ("cartpole", {"kind": "constant", "value": -50.0}, ["-50 on force, .* [-20, 20]: it is"]),
        ("cartpole", {"kind": "sine", "amplitude": 10, "frequencies": [1, 2]}, []),
        ("cartpole", {"kind": "sine", "amplitude": 11, "frequencies": [1, 2]}, ["22 on force"]),
        ("cartpole", {"kind": "periodic", "period": 1.0, "knots": {"*": [0, 30]}}, ["30 on force"]),
        ("cartpole", {"kind": "none"}, []),
        (
            "quadrotor",
            {"kind": "constant", "value": [-1, 7, 6, 0]},
            ["-1 on thrust1, .* [0, 6]", "7 on thrust2, .* [0, 6]"],
        ),
        ("quadrotor", {"kind": "sine", "amplitude": 2.4525}, []),
        ("quadrotor", {"kind": "sine", "amplitude": {"thrust3": 3.0}}, ["-0.5475 on thrust3"]),
        ("quadrotor", {"kind": "sine", "amplitude": 1, "offset": "zero"}, ["-1 on thrust."] * 4),
    ],
)
def test_controls_that_will_be_clamped_are_noticed(name, section, said):
    notices = controllers.clamped(ControlSection(**section), plant(name))
    assert len(notices) == len(said)
    for notice, pattern in zip(notices, said):
        assert re.search(pattern.replace("[", r"\["), notice), notice


def test_a_table_that_will_be_clamped_is_noticed_by_run(tmp_path):
    (tmp_path / "u.csv").write_text("0,1\n1,-30\n")
    changes = ["control.kind=csv", f"control.path={tmp_path / 'u.csv'}"]
    made = setup.build(experiment.resolve("cartpole", overrides=changes))
    assert (
        "control goes to -30 on force, whose ctrlrange is [-20, 20]: it is clamped" in made.notices
    )


# The kinds


def test_every_kind_is_described():
    assert set(kinds.KINDS) == set(ControlSection.model_fields["kind"].annotation.__args__)


def test_none_holds_the_keyframes_control():
    u = build("quadrotor", kind="none")(3, 0.3, states("quadrotor"))
    assert plant("quadrotor").u0.min() > 0
    np.testing.assert_array_equal(u, np.tile(plant("quadrotor").u0, (3, 1)))


def test_constant_holds_its_value_by_name_or_for_all():
    names = [f"{plant('quadrotor').model.actuator(i).name}" for i in range(4)]
    u = build("quadrotor", kind="constant", value={"*": 1.0, names[2]: 2.5})
    np.testing.assert_array_equal(u(0, 0.0, states("quadrotor")), np.tile([1, 1, 2.5, 1], (3, 1)))
    with pytest.raises(ControllerError, match=r"control\.value is missing"):
        build("quadrotor", kind="constant")
    with pytest.raises(DimensionError, match=r"control\.value has 2 values; expected 1 or 4"):
        build("quadrotor", kind="constant", value=[1.0, 2.0])
    with pytest.raises(ScenarioError, match=r"control\.value: 'forse' matches none .*'force'"):
        build("cartpole", kind="constant", value={"forse": 1.0})


@pytest.mark.parametrize("offset", ["keyframe", "zero"])
def test_sine_is_a_sum_of_tones_and_shifts_the_phase_from_actuator_to_actuator(offset):
    amplitude = [0.1, 0.2, 0.3, 0.4]
    sine = build(
        "quadrotor", kind="sine", amplitude=amplitude, frequencies=[0.4, 1.3], offset=offset
    )
    centre = plant("quadrotor").u0 if offset == "keyframe" else np.zeros(4)
    for t in (0.0, 0.37):
        expected = [
            c + a * sum(np.sin(2 * np.pi * (f * t + i / 4)) for f in (0.4, 1.3))
            for i, (a, c) in enumerate(zip(amplitude, centre))
        ]
        np.testing.assert_allclose(sine(0, t, states("quadrotor")), np.tile(expected, (3, 1)))


def test_random_control_of_a_run_does_not_depend_on_its_batch():
    whole = build("acrobot", range(10), kind="random", std=0.5)
    some = build("acrobot", [7, 2], steps=20, kind="random", std=0.5)
    other_seed = build("acrobot", range(10), seed=1, kind="random", std=0.5)
    for k in (0, 1, 19):
        u = whole(k, 0.0, states("acrobot", 10))
        np.testing.assert_array_equal(some(k, 0.0, states("acrobot", 2)), u[[7, 2]])
        assert (other_seed(k, 0.0, states("acrobot", 10)) != u).all()


def test_random_control_is_gauss_markov():
    period, tau, std, runs = plant("acrobot").period, 0.05, 0.5, 4000
    control = build(
        "acrobot", range(runs), 30, kind="random", std=std, time_constant=tau, offset="zero"
    )
    u = np.stack([control(k, 0.0, None)[:, 0] for k in range(30)])
    sigma = std**2 * np.sqrt(2 / runs)  # of a sample variance; a covariance's is at most that
    for k, lag in ((0, 0), (29, 0), (0, 3), (20, 5)):
        covariance = (u[k] * u[k + lag]).mean()
        assert abs(covariance - std**2 * np.exp(-lag * period / tau)) < 6 * sigma


# LQR


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_linearization_is_mujocos(name):
    p = plant(name)
    model, data, n = p.model, mujoco.MjData(p.model), p.space.n
    data.qpos, data.qvel, data.ctrl = p.x0[: model.nq], p.x0[model.nq :], p.u0
    A, B = np.zeros((n, n)), np.zeros((n, model.nu))
    mujoco.mjd_transitionFD(model, data, 1e-6, 1, A, B, None, None)
    got_A, got_B = controllers.linearize(p)
    np.testing.assert_allclose(got_A, A, atol=1e-7)
    np.testing.assert_allclose(got_B, B, atol=1e-7)


@pytest.mark.parametrize("name", ["cartpole", "quadrotor"])
def test_lqr_stabilizes(name):
    p, section = plant(name), experiment.resolve(name).control
    A, B = controllers.linearize(p)
    gain = controllers.lqr_gain(p, section)
    assert np.abs(np.linalg.eigvals(A)).max() > 1 - 1e-6  # it would not come back by itself
    assert np.abs(np.linalg.eigvals(A - B @ gain)).max() < 1 - 1e-3
    # And the nonlinear robot comes back from an eighth of a radian or metre.
    control, rows = build(name, range(4), **section.model_dump()), backend.create(p.model)
    nudge = np.random.default_rng(0).uniform(-0.125, 0.125, (4, p.space.n))
    x = p.space.plus(states(name, 4), nudge)
    for k in range(round(8 / p.period)):
        x = rows.step(x, control(k, k * p.period, x), k * p.period, p.nstep)
    assert np.abs(p.space.minus(x, states(name, 4))).max() < 0.01


def test_lqr_is_the_optimum_of_its_cost():
    p = plant("cartpole")
    section = ControlSection(kind="lqr", state_weight=[1, 10, 0.1, 0.1], control_weight=0.1)
    A, B = controllers.linearize(p)
    Q, R, x = np.diag([1, 10, 0.1, 0.1]), 0.1, np.array([0.1, 0.05, 0.0, 0.1])

    def cost(gain):
        total, state = 0.0, x
        for _ in range(3000):
            u = -gain @ state
            total, state = total + state @ Q @ state + R * u @ u, A @ state + B @ u
        return total

    gain = controllers.lqr_gain(p, section)
    best = cost(gain)
    for change in np.vstack([np.eye(4), -np.eye(4)]):
        assert cost(gain + 0.05 * np.abs(gain) * change) > best


def test_lqr_that_cannot_be():
    with pytest.raises(ControllerError, match=r"lqr: no stabilizing gain.*control_weight > 0"):
        build("cartpole", kind="lqr", control_weight=-0.1)
    with pytest.raises(ScenarioError, match=r"control\.state_weight: 'poel' matches none"):
        build("cartpole", kind="lqr", state_weight={"poel": 1.0})
    model = zoo_model("contact")  # no actuators
    x0 = np.concatenate([model.qpos0, np.zeros(model.nv)])
    free = controllers.Plant(model, setup.layout.state_space(model), x0, np.zeros(0), 1)
    with pytest.raises(ControllerError, match=r"lqr: no stabilizing gain"):
        controllers.build(ControlSection(kind="lqr"), free, 0, [0], 1)


# CSV


GAIT = {"kind": "periodic", "period": 0.5, "knots": {"thrust*": [2.0, 3.0, 1.0, 2.5]}}


def test_periodic_goes_through_its_knots_period_by_period_each_control_ahead_by_its_phase():
    phase = {"thrust2": 0.25, "thrust3": 0.6}
    controller = build("quadrotor", **GAIT, phase=phase, begin=0.2, ramp=0.1)
    x, u0 = states("quadrotor"), plant("quadrotor").u0
    np.testing.assert_array_equal(controller(0, 0.19, x), np.broadcast_to(u0, (3, 4)))
    knots = np.array([2.0, 3.0, 1.0, 2.5])
    for k in range(1, 9):
        at = controller(0, 0.2 + 0.125 * k, x)
        np.testing.assert_allclose(at[:, 0], knots[k % 4], atol=1e-9)
        np.testing.assert_allclose(at[:, 1], knots[(k + 1) % 4], atol=1e-9)
        np.testing.assert_allclose(at[0, 2], controller(0, 0.7 + 0.125 * k, x)[0, 2], atol=1e-9)
    half = controller(0, 0.25, x)
    whole = build("quadrotor", **GAIT, phase=phase, begin=0.2)(0, 0.25, x)
    np.testing.assert_allclose(half, (u0 + whole) / 2, atol=1e-12)
    # A closed spline: value and slope agree where the period ends.
    ends = [controller(0, 0.7 + 0.5 * n + side, x)[0] for n in (0, 1) for side in (-1e-6, 1e-6)]
    np.testing.assert_allclose(np.diff(ends[:2], axis=0), np.diff(ends[2:], axis=0), atol=1e-9)


def test_a_control_without_knots_keeps_the_keyframes():
    section = {**GAIT, "knots": {"thrust[12]": [0.0, 1.0], "thrust2": [3.0, 3.0]}}
    u = build("quadrotor", **section)(0, 0.25, states("quadrotor"))
    np.testing.assert_allclose(u[0], [1.0, 3.0, *plant("quadrotor").u0[2:]], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"period": None}, "control.period is missing; periodic needs the period"),
        ({"knots": {}}, "control.knots is missing"),
        ({"knots": {"trust*": [1.0, 2.0]}}, r"control.knots: 'trust\*' matches no control"),
    ],
)
def test_a_periodic_control_that_cannot_be(change, message):
    with pytest.raises(ControllerError, match=message):
        build("quadrotor", **{**GAIT, **change})


@pytest.mark.parametrize("header", ["", "t,force\n", "\ufefft,force\n", "\ufeff"])
def test_csv_holds_each_row_until_the_next(header, tmp_path):
    path = tmp_path / "u.csv"
    path.write_text(header + "0.1,1\n0.2,-2\n\n0.5,3\n", encoding="utf-8")
    control = build("cartpole", kind="csv", path=str(path))
    values = [control(0, t, states("cartpole"))[:, 0] for t in (0.0, 0.1, 0.15, 0.2, 0.49, 0.5, 9)]
    np.testing.assert_array_equal(values, [[u] * 3 for u in (1, 1, 1, -2, -2, 3, 3)])


def test_csv_rows_start_on_time_in_spite_of_rounding(tmp_path):
    path = tmp_path / "u.csv"
    path.write_text("0,0\n0.3,1\n")
    control = build("cartpole", kind="csv", path=str(path))
    assert control(0, 0.1 + 0.1 + 0.1 - 1e-16, states("cartpole"))[0] == 1  # just below 0.3


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (None, ControllerError, "cannot be read: No such file"),
        ("", ControllerError, "has no row of numbers"),
        ("t,force\n", ControllerError, "has no row of numbers"),
        ("0,1,2\n", DimensionError, r"row 1 has 3 columns; expected 2 \(t, force\)"),
        ("0\n", DimensionError, "row 1 has 1 columns"),
        ("t\n0,1\n", DimensionError, "row 1 has 1 columns"),
        ("t,force\n0,1\n0.1\n", DimensionError, "row 3 has 1 columns"),
        ("0,1\n0.1,x\n", ControllerError, "row 2: force is 'x'; use a finite number"),
        ("x,1\n", ControllerError, "row 1: t is 'x'; use a finite number"),
        ("t,force\n0,1\nnan,1\n", ControllerError, "row 3: t is 'nan'"),
        ("0,1\n\n1,-inf\n", ControllerError, "row 3: force is '-inf'"),
        ("0,1\n0,2\n", ControllerError, "row 2: t is 0 s after 0 s; the times must increase"),
        ("1,1\n0,2\n", ControllerError, "row 2: t is 0 s after 1 s"),
        ("force,t\n0,1\n", ControllerError, "row 1: column 1 is 'force'; expected 't'"),
        ("a,t\n0,1\n", ControllerError, "row 1: column 2 is 't'; expected 'force'"),
        ("0,1\n1," + "9" * 10**6, ControllerError, "row 2 cannot be read: field larger than"),
        ("0,1\n1,\udc80\n", ControllerError, "is not UTF-8 text"),
        ("0,1\n1," + "9" * 999, ControllerError, r"row 2: force is '9{30}\.\.\.'; use a finite"),
    ],
)
def test_csv_errors(text, error, message, tmp_path):
    path = tmp_path / "u.csv"
    if text is not None:
        path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(error, match=message):
        build("cartpole", kind="csv", path=str(path))


def test_csv_without_a_path():
    with pytest.raises(ControllerError, match=r"control\.path is missing"):
        build("cartpole", kind="csv")


# A user's function


def push(t, x):
    return x[:, :1] + t


def one_number(t, x):
    return 2.0


def raises(t, x):
    if t > 0.03:
        raise KeyError("gain")
    return 0.0


def not_finite(t, x):
    u = np.zeros((len(x), 1))
    u[2] = np.nan if t > 0.03 else 0.0
    return u


def wrong_shape(t, x):
    return np.zeros((len(x), 2))


def nothing(t, x):
    return None


def in_place(t, x):
    x *= 0.0
    return np.zeros((len(x), 1))


BUFFER = np.zeros((4, 1))


def same_array(t, x):
    BUFFER[:] = np.sin(20 * t)
    return BUFFER


def fresh_array(t, x):
    return np.full((4, 1), np.sin(20 * t))


def run_user(name, **arguments):
    function = f"{__name__}:{name}"
    overrides = ["control.kind=user", f"control.function={function}"]
    return estbench.run(
        "cartpole", ["ekf"], runs=4, duration=0.1, overrides=overrides, **arguments
    ).records["ekf"]


def test_user_function_sees_time_and_state():
    control = build("cartpole", kind="user", function=f"{__name__}:push")
    np.testing.assert_array_equal(
        control(7, 0.5, np.arange(12.0).reshape(3, 4)), [[0.5], [4.5], [8.5]]
    )


def test_one_number_is_for_all_runs_and_actuators():
    checked = controllers.checked(lambda k, t, x: one_number(t, x), "it", 4)
    np.testing.assert_array_equal(checked(0, 0.0, states("quadrotor")), np.full((3, 4), 2.0))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("raises", r":raises' raised at t = 0\.04 s: KeyError: 'gain'"),
        ("not_finite", r"a value that is not finite at t = 0\.04 s \(row 2 of 4\)"),
        ("wrong_shape", r":wrong_shape' returned shape \(4, 2\); expected \(4, 1\)"),
        ("nothing", "not finite|raised"),
        ("missing", r"control\.function: module .* has no function 'missing'"),
        ("BUFFER", "has no function 'BUFFER'"),
    ],
)  # fmt: skip
def test_bad_user_functions(name, message):
    with pytest.raises(ControllerError, match=message):
        run_user(name)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (None, r"control\.function is None; use 'module:function'"),
        ("no_colon", "'no_colon'; use 'module:function'"),
        ("no.such.module:f", r"control\.function: cannot import 'no\.such\.module'"),
    ],
)
def test_bad_names_of_user_functions(function, message):
    with pytest.raises(ControllerError, match=message):
        build("cartpole", kind="user", function=function)


def test_a_user_function_may_compute_in_place():
    quiet = estbench.run(
        "cartpole", ["ekf"], runs=4, duration=0.1, overrides=["control.kind=none"]
    ).records["ekf"]
    np.testing.assert_array_equal(run_user("in_place")["mse"], quiet["mse"])


def test_a_user_function_may_return_the_same_array_again():
    np.testing.assert_array_equal(run_user("same_array")["mse"], run_user("fresh_array")["mse"])
