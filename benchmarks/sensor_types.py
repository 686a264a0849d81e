"""What estbench does with each type of MuJoCo sensor: `python -m benchmarks.sensor_types`.

Every type (`mjtSensor`) is tried alone beside the encoders of a small robot, by `estbench.run` with
the EKF and the UKF. The robot turns about a hinge and slides over a floor, so that rays hit and
miss, bodies touch and part, and limits are reached. Prints the table of docs/sensors.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco

import estbench
from estbench.errors import EstbenchError
from estbench.robots import no_return

_ROBOT = """<mujoco><option timestep="0.005"/>{extension}
<asset><mesh name="pad" builtin="plate" params="2 2" scale=".1 .1 .01"/></asset>
<worldbody>
 <geom name="table" type="box" size=".3 .3 .05" pos="0 0 -1"/>
 <camera name="eye" pos="0 -3 0" xyaxes="1 0 0 0 0 1" resolution="2 2" fovy="30"/>
 <site name="zone" type="box" size=".2 .2 .5" pos="0 0 -.5"/>
 <body name="mast" pos="0 0 0"><joint name="lift" type="slide" axis="0 0 1" range="-.46 .3"
   limited="true" damping="1"/><geom type="sphere" size=".05" mass=".5"/>
  <site name="imu"/>
  <body name="arm"><joint name="tilt" axis="0 1 0" range="-.6 .6" limited="true" damping=".05"/>
   <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.45" size=".03" mass="1"/>
   <geom name="skin" type="mesh" mesh="pad" pos="0 0 -.45" contype="0" conaffinity="0" mass=".01"/>
   <site name="down" pos="0 0 -.5" euler="180 0 0" size=".06"/>
   <body name="ball" pos="0 0 -.2"><joint name="wrist" type="ball" damping=".02"/>
    <geom type="sphere" size=".03" pos=".05 0 0" mass=".1" contype="0" conaffinity="0"/></body>
  </body></body>
</worldbody>
<tendon><fixed name="string" limited="true" range="-.4 .4"><joint joint="tilt" coef="1"/></fixed>
</tendon>
<actuator><motor name="motor" joint="tilt"/><motor name="pull" tendon="string"/></actuator>
<sensor>{sensor}<jointpos name="enc_tilt" joint="tilt" noise=".01"/>
 <jointpos name="enc_lift" joint="lift" noise=".01"/>
 <ballquat name="enc_wrist" joint="wrist" noise=".01"/></sensor>
<keyframe><key name="k" qpos="-.4 .3 1 0 0 0"/></keyframe></mujoco>"""

_SITE = ("accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer")
_FRAME = ("framepos", "framequat", "framexaxis", "frameyaxis", "framezaxis", "framelinvel",
          "frameangvel", "framelinacc", "frameangacc")  # fmt: skip
_COLLISION = 'geom1="rod" geom2="table" cutoff=".2"'
_PLUGIN = '<extension><plugin plugin="mujoco.sensor.touch_grid"/></extension>'
_MORE = {
    "touch": 'site="down"',
    "rangefinder": 'site="down"',
    "camprojection": 'site="down" camera="eye"',
    "jointpos": 'joint="tilt"',
    "jointvel": 'joint="tilt"',
    "tendonpos": 'tendon="string"',
    "tendonvel": 'tendon="string"',
    "actuatorpos": 'actuator="motor"',
    "actuatorvel": 'actuator="motor"',
    "actuatorfrc": 'actuator="motor"',
    "jointactuatorfrc": 'joint="tilt"',
    "tendonactuatorfrc": 'tendon="string"',
    "ballquat": 'joint="wrist"',
    "ballangvel": 'joint="wrist"',
    "jointlimitpos": 'joint="lift"',
    "jointlimitvel": 'joint="lift"',
    "jointlimitfrc": 'joint="lift"',
    "tendonlimitpos": 'tendon="string"',
    "tendonlimitvel": 'tendon="string"',
    "tendonlimitfrc": 'tendon="string"',
    "subtreecom": 'body="arm"',
    "subtreelinvel": 'body="arm"',
    "subtreeangmom": 'body="arm"',
    "insidesite": 'objtype="body" objname="arm" site="zone"',
    "distance": _COLLISION,
    "normal": _COLLISION,
    "fromto": _COLLISION,
    "contact": 'geom1="rod" geom2="table" data="found force dist pos"',
    "e_potential": "",
    "e_kinetic": "",
    "clock": "",
    "tactile": 'geom="skin" mesh="pad"',
    "user": 'dim="2"',
    "plugin": 'plugin="mujoco.sensor.touch_grid" objtype="site" objname="down"',
}
ELEMENTS = (
    dict.fromkeys(_SITE, 'site="imu"')
    | dict.fromkeys(_FRAME, 'objtype="site" objname="down"')
    | _MORE
)
"""MJCF element -> its attributes."""
_CONFIG = '<config key="size" value="2 2"/><config key="fov" value="20 20"/>' + (
    '<config key="gamma" value="0"/><config key="nchannel" value="1"/>'
)


@dataclass(frozen=True)
class Outcome:
    """What estbench does with a type of sensor.

    Attributes:
        type: name in `mjtSensor`, without `mjSENS_`, in lower case.
        element: name of the MJCF element.
        answer: `works`, `no return` or `refused`.
        message: of the refusal, or how many runs failed.
    """

    type: str
    element: str
    answer: str
    message: str = ""


def robot(elements: Sequence[str]) -> str:
    """The MJCF of the robot with more sensors, each called like its element."""
    lines = []
    for element in elements:
        inside = _CONFIG if element == "plugin" else ""
        noise = "" if element in ("plugin", "tactile") else 'noise=".01"'
        lines.append(
            f'<{element} name="{element}" {ELEMENTS[element]} {noise}>{inside}</{element}>'
        )
    extension = _PLUGIN if "plugin" in elements else ""
    return _ROBOT.format(sensor="".join(lines), extension=extension)


def outcome(element: str, folder: Path, runs: int = 2, duration: float = 0.5) -> Outcome:
    """Try one element.

    Args:
        element: key of `ELEMENTS`.
        folder: where the MJCF is written.
        runs: of each estimator.
        duration: of each run, s.
    """
    path = folder / f"{element}.xml"
    path.write_text(robot([element]), encoding="utf-8")
    model = mujoco.MjModel.from_xml_path(str(path))
    kind = mujoco.mjtSensor(model.sensor(element).type[0]).name.removeprefix("mjSENS_").lower()
    try:
        result = estbench.run(path, ["ekf", "ukf"], runs=runs, duration=duration)
    except EstbenchError as error:
        return Outcome(kind, element, "refused", str(error))
    missing = no_return.may_miss(model, model.sensor(element).id)
    failed = sum(len(result[label].failures) for label in ("ekf", "ukf"))
    message = f"{failed} of {2 * runs} runs failed" if failed else ""
    return Outcome(kind, element, "no return" if missing else "works", message)


def outcomes() -> Iterator[Outcome]:
    """Try all elements."""
    with TemporaryDirectory() as folder:
        for element in ELEMENTS:
            yield outcome(element, Path(folder))


if __name__ == "__main__":
    print("| type (`mjtSensor`) | MJCF element | answer |\n|---|---|---|")
    for found in outcomes():
        detail = f": {found.message}" if found.message else ""
        print(f"| `{found.type}` | `{found.element}` | {found.answer}{detail} |")
