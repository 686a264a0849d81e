"""Conditions in which `benchmarks.contact` compares the filters, beside that of the examples."""

from collections.abc import Callable
from typing import Any

from estbench.robots import mjcf

Data = dict[str, Any]
"""A scenario as a table of settings."""
WRONG = 0.9
"""Factor of the filter's friction, masses and inertias."""


def noisier_process(data: Data, factor: float) -> Data:
    """The density of the true process noise, which the filter knows, times a factor."""
    density = data["process_noise"]["density"]
    scaled = {name: factor * value for name, value in density.items()}
    return data | {"process_noise": {"density": scaled}}


def noisier_sensors(data: Data, factor: float) -> Data:
    """The noise of each sensor, which the filter knows, times a factor."""
    channels = {
        name: channel | {"noise": factor * channel["noise"]}
        for name, channel in data["channels"].items()
    }
    return data | {"channels": channels}


def without_pose(data: Data) -> Data:
    """Encoders of the joints, and gyro and accelerometer of the torso in place of the pose fix."""
    encoders = {
        name: channel
        for name, channel in data["channels"].items()
        if channel["add"]["type"] == "jointpos" and not channel["add"]["object"].startswith("root")
    }
    imu = {
        kind: {"noise": noise, "add": {"type": kind, "object": "torso", "object_type": "body"}}
        for kind, noise in (("gyro", 0.02), ("accelerometer", 0.3))
    }
    return data | {"channels": encoders | imu}


def frame_skip(data: Data, count: int) -> Data:
    """The physics steps of a control step."""
    return data | {"model": data["model"] | {"frame_skip": count}}


def wrong_model(data: Data) -> Data:
    """Friction, masses and inertias of the filter's model are `WRONG` times the true ones."""
    model = mjcf.compile_model(mjcf.read(data["model"]["path"]))
    changed: dict[str, Any] = {}
    for i in range(1, model.nbody):
        body = model.body(i)
        name = body.name or f"body{i}"
        changed[f"body_mass.{name}"] = WRONG * float(body.mass[0])
        changed[f"body_inertia.{name}"] = (WRONG * body.inertia).tolist()
    for i in range(model.ngeom):
        geom = model.geom(i)
        changed[f"geom_friction.{geom.name or f'geom{i}'}"] = (WRONG * geom.friction).tolist()
    return data | {"filter": {"set": changed}}


CONDITIONS: dict[str, Callable[[Data], Data]] = {
    "as in the example": lambda data: data,
    "process noise x 0.1": lambda data: noisier_process(data, 0.1),
    "process noise x 10": lambda data: noisier_process(data, 10.0),
    "sensors x 3": lambda data: noisier_sensors(data, 3.0),
    "encoders and IMU only": without_pose,
    "frame skip 1": lambda data: frame_skip(data, 1),
    "frame skip 5": lambda data: frame_skip(data, 5),
    "friction and mass 10% low": wrong_model,
}
