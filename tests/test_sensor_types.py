"""Every type of MuJoCo sensor in one robot: nothing crashes, and the table of the docs is true."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import estbench
from benchmarks import sensor_types
from estbench.robots import no_return

DOCS = Path(__file__).parent.parent / "docs" / "sensors.md"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """The robot with every sensor."""
    return mujoco.MjModel.from_xml_string(sensor_types.robot(list(sensor_types.ELEMENTS)))


def kind(model: mujoco.MjModel, element: str) -> str:
    """Name of an element's type in `mjtSensor`."""
    return mujoco.mjtSensor(model.sensor(element).type[0]).name.removeprefix("mjSENS_").lower()


def test_the_robot_has_every_type(model: mujoco.MjModel) -> None:
    """A type that a later MuJoCo adds makes this test fail."""
    types = {name.removeprefix("mjSENS_").lower() for name in mujoco.mjtSensor.__members__}
    assert {kind(model, element) for element in sensor_types.ELEMENTS} == types


def test_the_table_of_the_docs_says_which_may_have_no_return(model: mujoco.MjModel) -> None:
    """One row for each type, with the answer of `benchmarks.sensor_types`."""
    text = DOCS.read_text(encoding="utf-8")
    for element in sensor_types.ELEMENTS:
        missing = no_return.may_miss(model, model.sensor(element).id)
        answer = "no return" if missing else "works"
        assert f"| `{kind(model, element)}` | `{element}` | {answer} |" in text


def test_estimators_take_all_types_at_once(tmp_path: Path) -> None:
    """Some 60 readings at each step, of which some have no return: no run fails."""
    path = tmp_path / "robot.xml"
    path.write_text(sensor_types.robot(list(sensor_types.ELEMENTS)), encoding="utf-8")
    result = estbench.run(path, ["ekf", "ukf"], runs=2, duration=0.05)
    for label in ("ekf", "ukf"):
        assert np.isfinite(result[label].anees.value)
