"""The text of a first scenario: TOML with a comment on each choice."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from glob import escape
from pathlib import Path

import numpy as np

from estbench.robots import layout
from estbench.starter import noise
from estbench.starter.control import Choice
from estbench.starter.robot import Robot
from estbench.starter.sensors import Entry

LARGE = 24
"""Coordinates beyond which the bound is left out: it is as slow as an EKF."""
HUGE = 80
"""Coordinates beyond which a run takes seconds."""


def write(robot: Robot, path: str, entries: Sequence[Entry], control: Choice) -> str:
    """The whole file.

    Args:
        robot: of the scenario.
        path: of the MJCF, relative to the file or in a package.
        entries: channels, in use or not.
        control: the controller.
    """
    n = robot.plant.space.n
    name = Path(path.rpartition(":")[2]).stem
    lines = [
        "#:schema ./scenario.schema.json",
        "# For editors: `estbench schema --out scenario.schema.json` writes the schema.",
        f"name = {_text(name)}",
        f'description = "{n} coordinates, {robot.model.nu} controls."',
    ]
    if n > LARGE:
        lines += ["bound = false                       # as slow as one EKF more"]
    parts = [
        lines, _model(robot, path), _simulation(n), _initial(robot), _noise(robot),
        _control(control), *map(_channel, entries), _estimators(robot),
    ]  # fmt: skip
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _model(robot: Robot, path: str) -> list[str]:
    model, steps = robot.model, robot.plant.nstep
    keys = [model.key(i).name or str(i) for i in range(model.nkey)]
    lines = ["[model]", f"path = {_text(path)}"]
    if keys:
        first = _text(keys[0]) if model.key(0).name else "0"
        lines.append(f"keyframe = {first:<26}# nominal state and control; one of {', '.join(keys)}")
    else:
        lines.append("# The MJCF has no keyframe, so qpos0 and no control are the nominal state.")
        if (pose := robot.settled()) is not None:
            numbers = " ".join(f"{round(q, 4) + 0.0:g}" for q in pose.tolist())
            lines += [
                "# The pose after 2 s of it, as a keyframe for the MJCF:",
                f'# <keyframe><key name="home" qpos="{numbers}"/></keyframe>',
            ]
    period = steps * float(model.opt.timestep)
    lines.append(
        f"frame_skip = {steps:<22} # physics steps of {model.opt.timestep:g} s: a filter step of "
        f"{period:g} s"
    )
    return lines


def _simulation(n: int) -> list[str]:
    return [
        "[simulation]",
        "duration = 2.0                      # s",
        f"runs = {20 if n <= HUGE else 4:<29}# 200 decide more verdicts",
        "seed = 0",
    ]


def _initial(robot: Robot) -> list[str]:
    kinds = robot.model.jnt_type
    patterns = {
        '"*" = 0.01': True,
        '"*.vel" = 0.05': bool(np.isin(kinds, (layout.SLIDE, layout.HINGE)).any()),
        '"*.v[xyz]" = 0.05': bool((kinds == layout.FREE).any()),
        '"*.w[xyz]" = 0.05': bool(np.isin(kinds, (layout.FREE, layout.BALL)).any()),
    }
    std = ", ".join(pattern for pattern, fits in patterns.items() if fits)
    return [
        "[initial]                           # the true state is drawn about the nominal one",
        f"std = {{ {std} }}   # m, rad; m/s, rad/s",
        'constraints = "all"                 # start on the constraints, and out of the ground',
    ]


def _noise(robot: Robot) -> list[str]:
    """Density of each velocity, those in a row that are alike as one list."""
    space, nv = robot.plant.space, robot.model.nv
    names, units = space.names[nv : 2 * nv], space.units[:nv]
    q = noise.density(robot)
    lines = [
        "[process_noise]                     # forces that the filter's model does not have:",
        f'kind = "force"                      # {noise.SHARE:.0%} of what each joint needs or '
        f"gives, for {noise.CORRELATION:g} s at a time",
        "",
        "[process_noise.density]",
    ]
    for name, unit, value in zip(names, units, q):
        force = "N" if unit == "m" else "N m"
        lines.append(f"{_text(escape(name))} = {value:.2g}   # ({force})² s")
    return lines


def _control(control: Choice) -> list[str]:
    lines = [f"[control]                           # {control.why}", f'kind = "{control.kind}"']
    if control.kind == "sine":
        lines += [
            "frequencies = [0.5]                 # Hz",
            f"amplitude = {_inline(control.sizes)}",
        ]
    elif control.kind == "random":
        lines += ["time_constant = 0.2                 # s", f"std = {_inline(control.sizes)}"]
    elif control.kind == "lqr":
        lines += [
            "state_weight = 1.0",
            "control_weight = 1.0",
            'observe = "reference"               # the estimate of one EKF: one truth for all',
        ]
    return lines


def _channel(entry: Entry) -> list[str]:
    """The table of a channel; one that is not in use is a comment if it is to be added."""
    lines = [f"[channels.{_key(entry.name)}]"]
    if not entry.objects:
        lines[0] = f"{lines[0]:<36}# {entry.kind}, in the MJCF"
        if entry.noise is None:
            lines.append(f"# noise = ...                       # {entry.unit}; default the MJCF's")
    if entry.noise is not None:
        lines.append(f"noise = {entry.noise:<28g}# {entry.unit}, standard deviation")
    if not entry.objects:
        return lines if entry.used else [*lines, "enabled = false"]
    one = len(entry.objects) == 1
    listed = json.dumps(entry.objects[0] if one else entry.objects, ensure_ascii=False)
    attached = f'object = {listed}, object_type = "{entry.object_type}"'
    lines.append(f'add = {{ type = "{entry.kind}", {attached} }}')
    return lines if entry.used else [f"# {line}" for line in lines]


def _estimators(robot: Robot) -> list[str]:
    if robot.touches:
        return [
            "[estimators.ekf]",
            "[estimators.rotated_ukf]            # for contact; see docs/contact.md",
        ]
    return ["[estimators.ekf]", "[estimators.ukf]"]


def _inline(sizes: Mapping[str, float]) -> str:
    values = set(sizes.values())
    if len(values) == 1:
        return f"{values.pop():g}"
    return f"{{ {_pairs(sizes.items())} }}"


def _pairs(items: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{_text(escape(name))} = {value:g}" for name, value in items)


def _text(value: str) -> str:
    """A TOML string."""
    return json.dumps(value, ensure_ascii=False)


def _key(name: str) -> str:
    """A TOML key: bare where that is allowed."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)
