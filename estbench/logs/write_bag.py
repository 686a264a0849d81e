"""Simulated runs as rosbag2 recordings in MCAP, written by `rosbags`.

Each channel is the topic `/channels/NAME` of sensor_msgs/JointState: `name` has the components,
`position` the values, the stamp of the header says when it was taken, and the recorder's when it
arrived. `/controls` has the controls in `effort`, and `/truth` the true state in `position`.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from estbench.errors import MissingExtraError
from estbench.experiment.prepared import Setup
from estbench.logs import clock
from estbench.logs.truth import true_states
from estbench.robots.layout import control_names, state_names
from estbench.scenario.log import LogChannel, LogColumns, LogSection, TruthSection
from estbench.sensors.delivery import divided
from estbench.shapes import Array
from estbench.simulation.sources import Trajectory

Message = tuple[str, int, int, Sequence[str], Array, bool]
"""Topic, ns of the recorder, ns of the header, names, values, whether they are an effort."""


def write(prepared: Setup, truth: Trajectory, run: int, folder: Path) -> None:
    """Write one run.

    Args:
        prepared: the experiment.
        truth: of several runs.
        run: its row among them.
        folder: of the bag; it is made.

    Raises:
        MissingExtraError: rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "logs") from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    joint_state = types.types["sensor_msgs/msg/JointState"]
    header, time = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    kind, none = "sensor_msgs/msg/JointState", np.zeros(0)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {}
        for topic, received, taken, names, values, effort in _messages(prepared, truth, run):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=types)
            stamp = time(sec=taken // 10**9, nanosec=taken % 10**9)
            place = (none, values) if effort else (values, none)
            message = joint_state(
                header=header(stamp=stamp, frame_id=""), name=list(names), position=place[0],
                velocity=none, effort=place[1],
            )  # fmt: skip
            bag.write(topics[topic], received, types.serialize_cdr(message, kind))


def section(prepared: Setup) -> LogSection:
    """The section `[log]` of the bags."""
    channels = {
        c.name: LogChannel(
            columns=[f"/channels/{c.name}.position{_called(c.name, i, c.space.nx)}"
                     for i in range(c.space.nx)],
            taken="stamp",
        )
        for c in prepared.channels
    }  # fmt: skip
    controls = {
        name: LogColumns(columns=[f"/controls.effort.{name}"])
        for name in control_names(prepared.plant.model)
    }
    return LogSection(
        time="received", instants="all", channels=channels, controls=controls,
        truth=TruthSection(states=true_states(prepared.space, "/truth.position.")),
    )  # fmt: skip


def _called(name: str, i: int, width: int) -> str:
    return f".{name}" if width == 1 else f".{name}.{i}"


def _messages(prepared: Setup, truth: Trajectory, run: int) -> Iterator[Message]:
    """The messages of one run, in order of arrival."""
    timestep = float(prepared.plant.model.opt.timestep)
    controls, states = control_names(prepared.plant.model), state_names(prepared.space)
    widths = {c.name: c.space.nx for c in prepared.channels}
    times = [0.0, *(i.end for i in prepared.instants)]
    for k, t in enumerate(times):
        now = int(clock.ticks(np.array(t)))
        for part in divided(truth.deliveries[k - 1]) if k else ():
            (name,) = part.channels
            if part.mask is None or part.mask[run]:
                on_time = part.taken == prepared.instants[k - 1].tick
                taken = now if on_time else int(clock.ticks(np.array(part.taken * timestep)))
                names = [_called(name, i, widths[name])[1:] for i in range(widths[name])]
                values = np.where(np.isfinite(part.y[run]), part.y[run], np.nan)
                yield f"/channels/{name}", now, taken, names, values, False
        if controls:
            u = truth.u[min(k, len(truth.u) - 1), run]
            yield "/controls", now, now, controls, u, True
        yield "/truth", now, now, states, truth.x[k, run], False
