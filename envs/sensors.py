"""Sensors for an environment that has none: tables, in Python or TOML; no XML is touched."""

import tomllib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from pydantic import ValidationError

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots.layout import BALL, FREE, object_name
from estbench.scenario.schema import ChannelSection
from estbench.sensors.channel import Channel

Table = dict[str, dict[str, Any]]
"""Channel -> settings of `[channels.NAME]`; `type` and `object` may stand beside `noise`."""
_MANY = {
    "encoder": "joint encoders", "position": "positions", "attitude": "attitudes", "gyro": "gyros",
}  # fmt: skip


def encoders(model: mujoco.MjModel, pattern: str = "*", noise: float | None = None) -> Table:
    """A position encoder on every hinge, slide and ball joint whose name matches.

    Args:
        model: compiled MuJoCo model, e.g. `env.unwrapped.model`.
        pattern: glob pattern of joint names.
        noise: standard deviation, rad or m; default by unit.

    Raises:
        ScenarioError: the pattern matches no such joint.
    """
    joints = {name: kind for name, kind in _joints(model) if kind != FREE}
    table: Table = {}
    for name, kind in joints.items():
        if fnmatchcase(name, pattern):
            sensor = "ballquat" if kind == BALL else "jointpos"
            table[f"{name}_encoder"] = _entry(sensor, name, "joint", noise)
    if not table and pattern != "*":
        raise ScenarioError(
            f"encoders: '{pattern}' matches no hinge, slide or ball joint"
            f"{did_you_mean(pattern, joints)}"
        )
    return table


def imu(body: str, gyro: float | None = None, accel: float | None = None) -> Table:
    """A gyro (rad/s) and an accelerometer (m/s²) at the origin of a body, with these std."""
    return {
        f"{body}_gyro": _entry("gyro", body, "xbody", gyro),
        f"{body}_accel": _entry("accelerometer", body, "xbody", accel),
    }


def position_fix(body: str, noise: float | None = None, rate: float | None = None) -> Table:
    """The position of a body's origin in the world (m), at a rate (Hz; default every step)."""
    entry = _entry("framepos", body, "xbody", noise)
    return {f"{body}_position": entry if rate is None else {**entry, "rate": rate}}


def attitude_fix(body: str, noise: float | None = None, rate: float | None = None) -> Table:
    """The attitude of a body (quaternion; noise in rad per axis), at a rate (Hz)."""
    entry = _entry("framequat", body, "xbody", noise)
    return {f"{body}_attitude": entry if rate is None else {**entry, "rate": rate}}


def default(model: mujoco.MjModel) -> Table:
    """An encoder on every joint; pose and gyro on every free body."""
    table = encoders(model)
    for joint, (_, kind) in enumerate(_joints(model)):
        if kind == FREE:
            index = int(model.jnt_bodyid[joint])
            body = object_name(model, mujoco.mjtObj.mjOBJ_BODY, index, "body")
            table |= position_fix(body) | attitude_fix(body)
            table[f"{body}_gyro"] = _entry("gyro", body, "xbody", None)
    return table


def summary(channels: Sequence[Channel]) -> str:
    """Channels of `default` in a few words, those alike as one: `8 joint encoders (0.01 rad)`."""
    alike: dict[tuple[str, str], list[str]] = {}
    for channel in channels:
        kind = channel.name.rpartition("_")[2]
        noise = f"{np.sqrt(channel.cov[0, 0]):g} {channel.space.units[0]}"
        alike.setdefault((kind, noise), []).append(channel.name)
    return ", ".join(
        f"{names[0] if len(names) == 1 else f'{len(names)} {_MANY[kind]}'} ({noise})"
        for (kind, noise), names in alike.items()
    )


def sections(
    sensors: str | Path | Sequence[str] | Mapping[str, Any] | None, model: mujoco.MjModel
) -> tuple[dict[str, ChannelSection], list[str] | None, list[str]]:
    """What a user asked for: settings by channel, channels in use (None: all), and notices.

    Args:
        sensors: names of the model's sensors; a table of channels; a TOML file with
            `[channels.NAME]` and perhaps `sensors = [names]`; or None for all that the model
            declares, or `default` if it declares none.
        model: the environment's compiled model.

    Raises:
        ScenarioError: a setting is wrong; every mistake is named.
    """
    use: list[str] | None = None
    if sensors is None:
        if model.nsensor:
            return {}, None, []
        table: Mapping[str, Any] = default(model)
        if not table:
            raise ScenarioError("the model has no joint: there is nothing to measure or estimate")
        return _validated(table), list(table), ["no sensors given and none in the model; using"]
    if isinstance(sensors, str | Path):
        data = _read(Path(sensors))
        table = data.get("channels", {})
        use = data.get("sensors", list(table) or None)
    elif isinstance(sensors, Mapping):
        table, use = sensors, list(sensors)
    else:
        table, use = {}, list(sensors)
    if use is not None and not use:
        raise ScenarioError("sensors is empty; name at least one, or leave it out for the default")
    return _validated(table), use, []


def _joints(model: mujoco.MjModel) -> list[tuple[str, int]]:
    kind = mujoco.mjtObj.mjOBJ_JOINT
    return [
        (object_name(model, kind, j, "joint"), int(model.jnt_type[j])) for j in range(model.njnt)
    ]


def _entry(sensor: str, name: str, kind: str, noise: float | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"add": {"type": sensor, "object": name, "object_type": kind}}
    return entry if noise is None else {**entry, "noise": noise}


def _validated(table: Mapping[str, Any]) -> dict[str, ChannelSection]:
    out, wrong = {}, []
    for name, given in table.items():
        entry = dict(given) if isinstance(given, Mapping) else {"noise": given}
        add = {k: entry.pop(k) for k in ("type", "object", "object_type") if k in entry}
        if add:
            entry["add"] = {**entry.get("add", {}), **add}
        try:
            out[name] = ChannelSection.model_validate(entry)
        except ValidationError as error:
            for e in error.errors():
                where = ".".join(str(part) for part in ("sensors", name, *e["loc"]))
                unknown = e["type"] == "extra_forbidden"
                known = [*ChannelSection.model_fields, "type", "object", "object_type"]
                hint = did_you_mean(str(e["loc"][-1]), known) if unknown else ""
                wrong.append(f"{where}: {'unknown key' if unknown else e['msg']}{hint}")
    if wrong:
        raise ScenarioError("; ".join(wrong))
    return out


def _read(path: Path) -> dict[str, Any]:
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"sensors '{path}' cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"sensors '{path}' is not valid TOML: {error}") from None
    unknown = [key for key in data if key not in ("channels", "sensors")]
    if unknown:
        hint = did_you_mean(unknown[0], ("channels", "sensors"))
        raise ScenarioError(f"sensors '{path}': unknown key '{unknown[0]}'{hint}")
    return data
