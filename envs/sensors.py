"""Sensors for an environment that has none: tables, in Python or TOML; no XML is touched."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
from pydantic import ValidationError

from estbench.errors import ScenarioError, did_you_mean
from estbench.scenario.channels import ChannelSection
from estbench.sensors.declared import expanded, lacks_sensors, names_expanded, usual
from estbench.sensors.kit import attitude_fix, default, encoders, imu, position_fix

__all__ = ["attitude_fix", "default", "encoders", "imu", "position_fix", "sections"]


def sections(
    sensors: str | Path | Sequence[str] | Mapping[str, Any] | None, model: mujoco.MjModel
) -> tuple[dict[str, ChannelSection], list[str] | None, bool]:
    """What a user asked for: settings by channel, channels in use (None: all).

    The last value says whether the sensors are those of `kit.default`, which nobody asked for.

    Args:
        sensors: names of the model's sensors; a table of channels; a TOML file with
            `[channels.NAME]` and perhaps `sensors = [names]`; or None for all that the model
            declares, or those of `kit.default` if it declares none.
        model: the environment's compiled model.

    Raises:
        ScenarioError: a setting is wrong; every mistake is named.
    """
    use: list[str] | None = None
    table: Mapping[str, Any]
    if sensors is None:
        if not lacks_sensors(model.nsensor, {}, None):
            return {}, None, False
        return usual(model, {}), None, True
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
    given, made = expanded(model, _validated(table), "sensors.{}.object")
    return given, None if use is None else names_expanded(use, made), False


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
