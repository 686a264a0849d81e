"""Parameters that no robot can have are refused, set or drawn; those that one can have are not."""

import mujoco
import numpy as np
import pytest

from estbench.envs import EstimatedObservation
from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.robots import parameters
from estbench.scenario.load import resolve
from estbench.simulation.truth import Simulator

WELDED = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body name="arm"><joint name="swing" type="hinge" axis="0 1 0"/>
        <geom name="rod" type="capsule" size="0.1 0.5"/>
        <body name="tool"><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body>
        <body name="tag"/>
    </body></worldbody></mujoco>"""
)

REFUSED = [
    ("body_mass.arm", -1.0, "'body_mass.arm' is -1.0: body_mass cannot be negative; change it"),
    ("body_mass.tag", -1.0, "body_mass cannot be negative"),
    ("body_inertia.arm", [1.0, -1.0, 1.0], r"is \[1.0, -1.0, 1.0\]: body_inertia cannot be neg"),
    ("body_inertia.arm", [1.0, 1.0, 5.0], "cannot exceed the sum of the two others"),
    ("dof_armature.swing", -0.5, "dof_armature cannot be negative"),
    ("dof_frictionloss.swing", -0.5, "dof_frictionloss cannot be negative"),
    ("geom_friction.rod", -0.5, "geom_friction cannot be negative"),
    ("dof_damping.swing", np.nan, "'dof_damping.swing' is nan; use finite numbers"),
    ("body_pos.arm", [0.0, np.inf, 0.0], "use finite numbers"),
    ("jnt_limited.swing", np.inf, "use finite numbers"),
    ("jnt_type.swing", 9, "'jnt_type' is no parameter but structure; change the MJCF"),
]


@pytest.mark.parametrize(("key", "value", "message"), REFUSED)
def test_a_value_that_no_robot_can_have(key, value, message):
    with pytest.raises(ScenarioError, match=f"^here: .*{message}"):
        parameters.changed(WELDED, {key: value}, "here")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("dof_damping.swing", -0.1),
        ("jnt_stiffness.swing", -1.0),
        ("dof_armature.swing", 0.0),
        ("body_mass.tag", 0.0),
        ("jnt_limited.swing", 1),
    ],
)
def test_what_is_unusual_may_be_meant(key, value):
    model = parameters.changed(WELDED, {key: value}, "here")
    field, rows = parameters.parameter(model, key, "here")
    np.testing.assert_array_equal(getattr(model, field)[rows], value)


@pytest.mark.parametrize("field", ["body_mass", "body_inertia"])
def test_a_moving_body_has_mass_if_only_in_a_body_welded_to_it(field):
    light = parameters.changed(WELDED, {f"{field}.arm": 0.0}, "here")
    mujoco.mj_step(light, data := mujoco.MjData(light))
    assert np.isfinite(data.qacc).all()
    with pytest.raises(ScenarioError, match=f"a moving body needs a {field} above 0"):
        parameters.changed(WELDED, {f"{field}.arm": 0.0, f"{field}.tool": 0.0}, "here")


@pytest.mark.parametrize(
    ("section", "where"),
    [
        ("model.set", "model.set"),
        ("truth.set", "truth.set"),
        ("filter.set", "filter.set"),
        ("estimators.ekf.type='imm'|estimators.ekf.models=[{},%]", "estimators.ekf.models"),
    ],
)
def test_each_section_that_sets_a_parameter_names_itself(section, where):
    table = '{"body_mass.pole" = -1.0}'
    changes = [
        text.replace("%", table) if "=" in text else f"{text}={table}"
        for text in section.split("|")
    ]
    with pytest.raises(ScenarioError, match=f"^{where}: 'body_mass.pole' is -1.0"):
        setup.build(resolve("cartpole", overrides=changes))


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_the_wrapper_of_an_environment_names_its_argument(value):
    gym = pytest.importorskip("gymnasium")
    env = gym.make("InvertedPendulum-v5")
    with pytest.raises(ScenarioError, match=f"^model_set: 'body_mass.pole' is {value}"):
        EstimatedObservation(env, estimator="ekf", model_set={"body_mass.pole": value})


def drawing(key, **spread):
    table = ", ".join(f"{name} = {value}" for name, value in spread.items())
    return resolve("cartpole", overrides=[f'truth.draw={{"{key}" = {{{table}}}}}'])


@pytest.mark.parametrize(
    ("key", "spread", "message"),
    [
        ("body_mass.pole", {"relative_std": 0.3}, "may be drawn as -0.07, 4.5 standard deviations"),
        ("body_mass.pole", {"std": 0.1}, "body_mass cannot be negative; lower its relative_std or"),
        ("dof_armature.pole", {"std": 0.01}, "dof_armature cannot be negative"),
        ("body_mas.pole", {"std": 0.1}, "no model field 'body_mas'"),
    ],
)
def test_a_spread_that_reaches_what_no_robot_can_have(key, spread, message):
    with pytest.raises(ScenarioError, match=f"^truth.draw: .*{message}"):
        setup.build(drawing(key, **spread))


def test_no_draw_goes_beyond_the_limit(monkeypatch):
    """The widest spread that is let through stays positive, however unlikely the draw."""
    prepared = setup.build(drawing("body_mass.pole", relative_std=0.22))
    monkeypatch.setattr(
        "estbench.randomness.streams.normals", lambda *a: np.full((a[3], 3, a[4]), -9.0)
    )
    seen = []
    monkeypatch.setattr(
        "estbench.robots.batch.BatchBackend.vary", lambda self, *a: seen.append(a[-1])
    )
    assert isinstance(prepared.simulator([0, 1, 2]), Simulator)
    np.testing.assert_allclose(seen[0], 0.2 * (1 - 0.22 * parameters.LIMIT))
    assert (seen[0] > 0).all()
