"""Which sensors a robot has: those of its MJCF, those that are added, or, without any, the usual.

One rule for scenarios and for environments of other libraries. One entry may add a sensor to many
objects; it becomes one channel for each of them, `OBJECT_NAME`.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco

from estbench.errors import ScenarioError, did_you_mean
from estbench.robots.added_sensors import object_kind, object_names
from estbench.robots.layout import BALL, FREE
from estbench.scenario.channels import AddSensor, ChannelSection
from estbench.sensors import kit

Sections = dict[str, ChannelSection]


def lacks_sensors(
    nsensor: int, sections: Mapping[str, ChannelSection], use: Sequence[str] | None
) -> bool:
    """Whether neither the MJCF nor the scenario declares a sensor, nor says that there is none."""
    own = any(s.add or s.of is not None or s.function is not None for s in sections.values())
    return not nsensor and use is None and not own


def is_open(add: AddSensor) -> bool:
    """Whether the model is needed to know the object: an index, a list or a pattern."""
    return not isinstance(add.object, str) or any(c in add.object for c in "*?[")


def usual(model: mujoco.MjModel, sections: Mapping[str, ChannelSection]) -> Sections:
    """The sensors of a robot that declares none (`kit.default`), with the settings of `sections`.

    Raises:
        ScenarioError: the model has no joint.
    """
    table = kit.default(model)
    if not table:
        raise ScenarioError("the model has no joint: there is nothing to measure or estimate")
    made = {name: ChannelSection.model_validate(entry) for name, entry in table.items()}
    for name, own in sections.items():
        given = {key: getattr(own, key) for key in own.model_fields_set}
        kept = made[name].model_dump(exclude_unset=True) if name in made else {}
        if {"cov", "noise_density"} & set(given):
            kept.pop("noise", None)
        made[name] = ChannelSection.model_validate({**kept, **given})
    return made


def expanded(
    model: mujoco.MjModel, sections: Mapping[str, ChannelSection], where: str
) -> tuple[Sections, dict[str, list[str]]]:
    """The sections with one object each, and the channels that came from each open one.

    Args:
        model: the compiled model.
        sections: settings by channel.
        where: the setting that names the object, with `{}` for the channel, for messages.

    Raises:
        ScenarioError: an index, name or pattern has no object, or two channels get one name.
    """
    out: Sections = {}
    made: dict[str, list[str]] = {}
    for name, section in sections.items():
        add = section.add
        if add is None or not is_open(add):
            new = {name: section}
        else:
            objects, many = _objects(model, add, f"{where.format(name)}")
            new = {
                f"{found}_{name}" if many else name: section.model_copy(
                    update={"add": add.model_copy(update={"object": found})}
                )
                for found in objects
            }
            made[name] = list(new)
        taken = [n for n in new if n in out or (n in sections and n != name)]
        if taken:
            raise ScenarioError(f"{where.format(name)}: a channel '{taken[0]}' exists; rename one")
        out |= new
    return out, made


def names_expanded(names: Sequence[str], made: Mapping[str, list[str]]) -> list[str]:
    """Names of channels, with those of an open entry in place of its own name."""
    return [n for name in names for n in made.get(name, [name])]


def _objects(model: mujoco.MjModel, add: AddSensor, where: str) -> tuple[list[str], bool]:
    """Names of the objects of an open entry, and whether it may have several."""
    kind = object_kind(add).removeprefix("x")
    names = object_names(model, kind)
    if isinstance(add.object, str):
        if add.object in names:  # a name that has such a character
            return [add.object], False
        fitting = [names[i] for i in range(len(names)) if _fits(model, add.type, kind, i)]
        found = [name for name in fitting if fnmatchcase(name, add.object)]
        if not found:
            what = f"{kind} that a {add.type} fits" if kind == "joint" else kind
            hint = did_you_mean(add.object, fitting)
            raise ScenarioError(f"{where}: '{add.object}' matches no {what}{hint}")
        return found, True
    many = isinstance(add.object, list)
    wanted = add.object if isinstance(add.object, list) else [add.object]
    if not wanted:
        raise ScenarioError(f"{where} is an empty list; name at least one {kind}")
    found = []
    for one in wanted:
        if isinstance(one, int) and not 0 <= one < len(names):
            limits = f"there are {len(names)}, numbered from 0" if names else "there is none"
            raise ScenarioError(f"{where}: no {kind} {one}; {limits}")
        found.append(names[one] if isinstance(one, int) else one)
    return list(dict.fromkeys(found)), many


def _fits(model: mujoco.MjModel, sensor: str, kind: str, index: int) -> bool:
    """Whether a pattern means this object: a joint of the right type, no world body."""
    if kind == "joint":
        joint = model.jnt_type[index]
        return joint == BALL if sensor.startswith("ball") else joint not in (BALL, FREE)
    return kind != "body" or index > 0
