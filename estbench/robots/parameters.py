"""Parameters of a compiled model by name: find, set and draw them.

MuJoCo checks masses when it compiles an MJCF, but not a parameter that is set afterwards. Values
that are physically impossible are refused here.
"""

import copy
import re
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from estbench.errors import ScenarioError, did_you_mean
from estbench.randomness import streams
from estbench.shapes import Array, Float

LIMIT = 4.5
"""Draws are limited to so many standard deviations; 7 of a million normal draws exceed them."""

SETTINGS = re.compile(r"(contype|conaffinity|condim|priority|limited|gravcomp|active0)$")
"""Integer fields that may be set on a compiled model; the rest are types, addresses and counts."""

# Damping and stiffness may be negative on purpose.
_NOT_NEGATIVE = {
    "body_mass", "body_inertia", "dof_armature", "dof_frictionloss", "tendon_armature",
    "tendon_frictionloss", "actuator_armature", "geom_size", "geom_friction",
}  # fmt: skip

_PREFIXES = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "site": mujoco.mjtObj.mjOBJ_SITE,
}
_N = {"body": "body", "geom": "geom", "actuator": "u", "tendon": "tendon", "site": "site",
      "jnt": "jnt", "dof": "jnt"}  # fmt: skip


def parameter(model: mujoco.MjModel, key: str, where: str) -> tuple[str, int | slice]:
    """Field name and index of `field.object`, e.g. `body_mass.pole`, `dof_damping.hinge`.

    Raises:
        ScenarioError: the field or the object does not exist.
    """
    field, _, name = key.partition(".")
    prefix = field.split("_")[0]
    if hint := unknown_field(field):
        raise ScenarioError(f"{where}: {hint}")
    if getattr(model, field).dtype.kind != "f" and not SETTINGS.search(field):
        raise ScenarioError(f"{where}: '{field}' is no parameter but structure; change the MJCF")
    kind = _PREFIXES[prefix]
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        count = {"dof": model.njnt, "jnt": model.njnt}.get(prefix, getattr(model, f"n{_N[prefix]}"))
        names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(count)]
        raise ScenarioError(f"{where}: '{key}': no {prefix} '{name}'{did_you_mean(name, names)}")
    if prefix != "dof":
        return field, index
    start = int(model.jnt_dofadr[index])
    width = {0: 6, 1: 3}.get(int(model.jnt_type[index]), 1)
    return field, slice(start, start + width)


def unknown_field(field: str) -> str:
    """Words for a field that no MuJoCo model has, with the ones that are meant; else empty."""
    fields = [f for f in dir(mujoco.MjModel) if f.split("_")[0] in _PREFIXES and "_" in f]
    return "" if field in fields else f"no model field '{field}'{did_you_mean(field, fields)}"


def changed(
    model: mujoco.MjModel, settings: Mapping[str, float | Sequence[float]], where: str
) -> mujoco.MjModel:
    """A copy of a compiled model with parameters `field.object` -> value, and derived constants.

    Without settings it is the model itself.

    Raises:
        ScenarioError: a parameter does not exist, or a value is physically impossible; the message
            names all of them.
    """
    if not settings:
        return model
    model, mistakes, assigned = copy.copy(model), [], {}
    for key, value in settings.items():
        try:
            assign(model, key, value, where)
            assigned[key] = value
        except ScenarioError as error:
            mistakes.append(str(error))
    for key, value in assigned.items():  # a body may get its mass from a body that is welded to it
        wrong = flaw(model, *parameter(model, key, where))
        if wrong:
            mistakes.append(f"{where}: '{key}' is {value}: {wrong}; change it, or leave it out")
    if mistakes:
        raise ScenarioError("; ".join(mistakes))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def assign(
    model: mujoco.MjModel, key: str, value: float | Sequence[float], where: str = "set"
) -> None:
    """Set `field.object` of a compiled model; a scalar sets every element of a vector."""
    field, rows = parameter(model, key, where)
    target = getattr(model, field)
    try:
        numbers = np.asarray(value, dtype=np.float64)
        target[rows] = np.where(np.isfinite(numbers), numbers, 0.0)
    except (TypeError, ValueError):
        got = repr(value) if isinstance(value, str) else np.size(value)
        raise ScenarioError(
            f"{where}: '{key}' takes {np.size(target[rows])} numbers, got {got}"
        ) from None
    if not np.isfinite(numbers).all():
        raise ScenarioError(f"{where}: '{key}' is {value}; use finite numbers")


def check_draw(model: mujoco.MjModel, key: str, relative_std: float, std: float) -> None:
    """Refuse a distribution from which a physically impossible parameter may be drawn.

    Raises:
        ScenarioError: the parameter does not exist, or the lowest value that may be drawn is
            impossible.
    """
    field, rows = parameter(model, key, "truth.draw")
    model = copy.copy(model)
    values = getattr(model, field)
    values[rows] = lowest = drawn(values[rows], relative_std, std, np.array(-LIMIT))[0]
    wrong = flaw(model, field, rows)
    if wrong:
        raise ScenarioError(
            f"truth.draw: '{key}' may be drawn as {np.min(lowest):.3g}, {LIMIT:g} standard "
            f"deviations below its nominal value: {wrong}; lower its relative_std or std"
        )


def drawn(nominal: Array, relative_std: float, std: float, z: Array) -> Array:
    """Values nominal (1 + relative_std z) + std z `(run, ...)` from standard normals z `(run,)`.

    z is limited to ± `LIMIT`, so that a check of the lowest value by `flaw` holds for all.
    """
    z = np.clip(z, -LIMIT, LIMIT).reshape(-1, *([1] * np.ndim(nominal)))
    return nominal * (1 + relative_std * z) + std * z


def of_runs(
    model: mujoco.MjModel, key: str, spread: tuple[float, float], seed: streams.Seeds,
    runs: Sequence[int],
) -> tuple[str, int | slice, Array]:  # fmt: skip
    """Field, index and values `(run, ...)` of a parameter that is drawn once per run.

    Args:
        model: with the nominal value.
        key: `field.object`.
        spread: relative and absolute standard deviation; see `drawn`.
        seed: of all runs, or one for each.
        runs: their numbers.
    """
    return of_normals(model, key, spread, normals(key, seed, runs))


def normals(key: str, seed: streams.Seeds, runs: Sequence[int]) -> Float[Array, "run 1"]:
    """The standard normal number of each run from which a parameter is drawn."""
    return streams.normals(seed, runs, f"parameter:{key}", 1, 1)[0]


def of_normals(
    model: mujoco.MjModel, key: str, spread: tuple[float, float], z: Float[Array, "run 1"]
) -> tuple[str, int | slice, Array]:
    """As `of_runs`, from the standard normal numbers z."""
    field, index = parameter(model, key, "truth.draw")
    return field, index, drawn(getattr(model, field)[index], *spread, z)


def flaw(model: mujoco.MjModel, field: str, rows: int | slice) -> str | None:
    """Why the value of a parameter is impossible; None if it is possible.

    A moving body must have mass and inertia, its own or that of the bodies welded to it, as in
    MuJoCo's compiler.
    """
    value = getattr(model, field)[rows]
    if field in _NOT_NEGATIVE and (value < 0).any():
        return f"{field} cannot be negative"
    if field not in ("body_mass", "body_inertia"):
        return None
    if field == "body_inertia" and 2 * value.max() > value.sum() * (1 + 1e-9):
        return "a principal moment of inertia cannot exceed the sum of the two others"
    root = model.body_weldid[rows]
    there = np.c_[model.body_mass, model.body_inertia] >= mujoco.mjMINVAL
    if model.body_dofnum[root] and not there[model.body_weldid == root].all(axis=1).any():
        return f"a moving body needs a {field} above 0"
    return None
