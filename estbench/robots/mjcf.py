"""Reading an MJCF and compiling the model that the truth or the filter steps.

Every compiled model gets the flags of `flags.set_flags`.
"""

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots import added_sensors
from estbench.robots.compiling import compiled
from estbench.robots.flags import set_flags
from estbench.robots.parameters import changed
from estbench.shapes import Array, Float

INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


def locate(path: str) -> Path:
    """The file at `package:path/in/package` or at a plain path.

    The package is found, not imported: a path runs no code.

    Raises:
        ScenarioError: the package is not installed, or the file does not exist.
    """
    package, colon, inside = path.partition(":")
    if colon and len(package) > 1:  # one letter is a Windows drive
        file = _folder(package, f"model.path '{path}'") / inside
    else:
        file = Path(path)
    if not file.is_file():
        raise ScenarioError(f"model.path '{path}': no file {file}")
    return file


def _folder(package: str, where: str) -> Path:
    """The folder of an installed package, which may be inside another one (`a.b`)."""
    top, *inside = package.split(".")
    try:
        found = find_spec(top)
    except ValueError:  # no name of a package
        found = None
    if found is None:
        raise ScenarioError(f"{where}: package '{package}' is not installed")
    for place in found.submodule_search_locations or ():
        return Path(place).joinpath(*inside)
    raise ScenarioError(f"{where}: '{package}' is a module; use package:path/in/package")


def read(path: str, sensors: Mapping[str, Any] | None = None) -> mujoco.MjSpec:
    """The editable model of an MJCF with sensors added to it.

    Args:
        path: as for `locate`.
        sensors: name -> object with `type`, `object`, `object_type` (see `sections.AddSensor`).

    Raises:
        ScenarioError: the MJCF cannot be parsed, or a sensor cannot be added.
    """
    file = locate(path)
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise ScenarioError(f"{file} is not a valid MJCF: {_one_line(error)}") from None
    added_sensors.add(spec, sensors or {}, file.name)
    return spec


def compile_model(
    spec: mujoco.MjSpec,
    *,
    timestep: float | None = None,
    integrator: str | None = None,
    settings: Mapping[str, float | Sequence[float]] | None = None,
    where: str = "model",
) -> mujoco.MjModel:
    """Compile without delays and histories, and apply the overrides.

    The sensor attributes `interval`, `delay` and `nsample` of MuJoCo are cleared: estbench applies
    rates and delays itself, to noise-free readings. Actuator delays cannot be cleared without a
    change of the robot, so they are refused.

    Raises:
        ScenarioError: the MJCF does not compile, has actuator delays, or an override names no
            parameter.
    """
    try:
        # Before the copy: `MjSpec.copy` drops elements with an invalid reference and reports
        # nothing.
        compiled(spec)
        spec = spec.copy()
        for sensor in spec.sensors:
            sensor.nsample, sensor.delay, sensor.interval = 0, 0.0, [0.0, 0.0]
        for i, actuator in enumerate(spec.actuators):
            if actuator.nsample > 0:
                name = actuator.name or f"actuator{i}"
                raise ScenarioError(
                    f"actuator '{name}' has nsample={actuator.nsample}: its delay is a "
                    "hidden state that no estimator sees; remove nsample and delay from the MJCF"
                )
        model = compiled(spec)
    except ValueError as error:
        raise ScenarioError(f"{where}: MJCF does not compile: {_one_line(error)}") from None
    if timestep is not None:
        model.opt.timestep = timestep
    if integrator is not None:
        model.opt.integrator = INTEGRATORS[integrator]
    if settings:
        model = changed(model, settings, f"{where}.set")
    set_flags(model)
    return model


def keyframe(
    model: mujoco.MjModel, key: str | int | None
) -> tuple[Float[Array, " nx"], Float[Array, " nu"]]:
    """State (qpos, qvel, act) and control of a keyframe.

    None is the first keyframe; if there is no keyframe, qpos0 at rest with zero control.

    Raises:
        ScenarioError: the keyframe does not exist.
    """
    if key is None and not model.nkey:
        x = np.concatenate([model.qpos0, np.zeros(model.nv + model.na)])
        return x, np.zeros(model.nu)
    index = keyframe_number(model, key)
    x = np.concatenate([model.key_qpos[index], model.key_qvel[index], model.key_act[index]])
    return x, model.key_ctrl[index].copy()


def keyframe_number(model: mujoco.MjModel, key: str | int | None) -> int:
    """The number of a keyframe; that of None is 0.

    Raises:
        ScenarioError: the keyframe does not exist.
    """
    names = [model.key(i).name for i in range(model.nkey)]
    if key is None:
        return 0
    index = names.index(key) if key in names else key if isinstance(key, int) else -1
    if not 0 <= index < model.nkey:
        known = [name or str(i) for i, name in enumerate(names)]
        hint = did_you_mean(str(key), known) or "; the MJCF has none: leave model.keyframe out"
        raise ScenarioError(f"model.keyframe: no keyframe '{key}'{hint}")
    return index


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
