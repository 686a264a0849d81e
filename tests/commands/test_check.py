"""`estbench check` names every mistake that no other depends on, and none that is not made."""

import pytest

from estbench.commands import inspection
from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.scenario.load import resolve
from tests.helpers import ZOO

MISTAKES = {
    'sensors=["cart_encodr", "giro"]': [
        "sensors: no sensor 'cart_encodr' (did you mean 'cart_encoder' or 'pole_encoder'?); "
        "no sensor 'giro' (did you mean 'gyro'?)"
    ],
    'filter.set={"dof_dampin.pole" = 1}': ["filter.set: no model field 'dof_dampin'"],
    'truth.set={"body_mas.pole" = 1, "body_mass.pole" = -1}': [
        "truth.set: no model field 'body_mas'",
        "truth.set: 'body_mass.pole' is -1.0: body_mass cannot be negative",
    ],
    'truth.draw={"body_mass.pol" = {std = 0.01}}': ["truth.draw: 'body_mass.pol': no body 'pol'"],
    "estimators.efk={}": ["no estimator 'efk'"],
    "estimators.ukf={alfa = 1}": ["ukf: no setting 'alfa'"],
    'initial.std={"car" = 1, "pole.val" = 2}': [
        "initial.std: 'car' matches none (did you mean 'cart'?); 'pole.val' matches none"
    ],
    'start.offset={"pol" = 1}': ["'pol' matches none"],
    'process_noise.density={"pole.v" = 1}': ["process_noise.density: 'pole.v' matches none"],
    "control={kind = 'constant', value = {push = 1}}": ["'push' matches none"],
    "consistency.burn_in=9": ["consistency.burn_in is 9 s, which leaves nothing"],
}


def said(overrides):
    with pytest.raises(ScenarioError) as error:
        inspection.render(resolve("cartpole", overrides=list(overrides)))
    return str(error.value)


@pytest.mark.parametrize("override", MISTAKES)
def test_one_mistake_is_said_once_and_alone(override):
    message = said([override])
    assert all(message.count(part) == 1 for part in MISTAKES[override])
    others = (part for o, parts in MISTAKES.items() if o != override for part in parts)
    assert not any(part in message for part in others)


def test_all_mistakes_at_once():
    message = said(MISTAKES)
    for parts in MISTAKES.values():
        for part in parts:
            assert message.count(part) == 1
    assert "\n" not in message


def test_the_model_is_said_alone():
    for override in ("model.path=nothing.xml", 'model.set={"body_mass.pole" = -1}'):
        message = said([override, "estimators.efk={}"])
        assert message.startswith("model")
        assert "efk" not in message


def test_a_robot_without_a_sensor_of_its_own(tmp_path):
    robot = tmp_path / "robot.xml"
    robot.write_text(ZOO["activations"].split("<sensor>")[0] + "</mujoco>")
    wrong = ["channels.a.add={type = 'jointpso', object = 'hinge'}", "estimators.efk={}"]
    message, other = inspection.mistakes(resolve(robot, overrides=wrong))
    assert "efk" in other
    assert message.startswith("channels.a.add.type: no sensor type 'jointpso' (did you mean 'jo")
    right = wrong[0].replace("jointpso", "jointpos")
    assert setup.build(resolve(robot, overrides=[right])).channels[0].name == "a"
