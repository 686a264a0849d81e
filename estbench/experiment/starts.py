"""x̂₀ and P₀ of a scenario, and which constraints the true states at the start meet."""

import mujoco
import numpy as np

from estbench.errors import CovarianceError, DimensionError
from estbench.robots import contacts, overlaps
from estbench.robots.feasible import has_equalities
from estbench.robots.held import held
from estbench.scenario.schema import InitialSection, Scenario
from estbench.sensors import datasheet
from estbench.shapes import Array, Bool, Float, Mask
from estbench.simulation.initial import Constraints, InitialStates
from estbench.spaces.manifold import Manifold
from estbench.spaces.patterns import expand

_MOVED = 1e-3
"""Change of a coordinate of x̂₀, in its unit, that is worth a notice."""
_LOOPED = 10.0
"""Divisor of the default standard deviation of a robot with equality constraints."""


def build(
    scenario: Scenario,
    model: mujoco.MjModel,
    space: Manifold,
    x0: Float[Array, " nx"],
    notices: list[str],
) -> tuple[InitialStates, Float[Array, " nx"], Float[Array, "n n"]]:
    """How the true states at the start are drawn, x̂₀ and P₀.

    Args:
        scenario: for its `[initial]`.
        model: the true model.
        space: its state space.
        x0: the keyframe.
        notices: assumptions are appended here.

    Raises:
        CovarianceError: P₀ is not positive semidefinite.
        DimensionError: the count of values or the shape of P₀ is wrong.
    """
    section = scenario.initial
    if not _says_spread(section):
        section = section.model_copy(update={"std": default_std(model).tolist()})
    centre, spread = _given(section, model, space, x0)
    kind = _constraints(scenario.initial, model)
    initial = InitialStates.build(model, space, centre, spread, kind)
    mean, cov = initial.moments(model, space)
    if not np.array_equal(cov, spread):
        notices.append(_notice(initial.constraints, model))
    moved = np.abs(space.minus(initial.mean, centre))
    if moved.max() > _MOVED:
        worst = int(moved.argmax())
        notices.append(
            f"the start itself violates constraints: x̂₀ is moved, {space.names[worst]} by "
            f"{moved[worst]:.3g} {space.units[worst]}"
        )
    deep = overlaps.overlaps(model, initial.mean)
    if deep:
        notices.append(overlaps.note(deep))
    return initial, mean, cov


def default_std(model: mujoco.MjModel) -> Float[Array, " n"]:
    """Standard deviation of each coordinate of x₀ where the scenario gives none, in its unit.

    Zero for a velocity that is held by its damping (`robots.held`).

    With equality constraints it is small: joints of a gripper of some grams turn by tens of rad/s
    when a loop that is wrong by 0.05 rad closes, which no Gaussian belief describes.
    """
    return np.where(still(model), 0.0, default_number(model))


def default_number(model: mujoco.MjModel) -> float:
    """The number that `default_std` is, where it is not zero."""
    std = InitialSection().std
    assert isinstance(std, float)
    return std / _LOOPED if has_equalities(model) else std


def still(model: mujoco.MjModel) -> Bool[Mask, " n"]:
    """The tangent coordinates that are velocities held by their damping."""
    out = np.zeros(2 * model.nv + model.na, bool)
    out[model.nv : 2 * model.nv] = held(model)
    return out


def _says_spread(section: InitialSection) -> bool:
    return bool({"std", "cov"} & section.model_fields_set)


def _constraints(section: InitialSection, model: mujoco.MjModel) -> Constraints:
    """The constraints that states at the start are moved to meet."""
    wanted = section.constraints
    if wanted == "auto":
        wanted = "equality" if _says_spread(section) else "all"
    if wanted == "all" and contacts.colliding(model).any():
        return "all"
    return "equality" if wanted != "none" and has_equalities(model) else "none"


def _notice(kind: Constraints, model: mujoco.MjModel) -> str:
    """What happens to the draws and to P₀."""
    met = ["on the equality constraints"] if has_equalities(model) else []
    met += ["out of contacts deeper than 1 cm"] if kind == "all" else []
    return (
        f"x₀ is drawn and believed {' and '.join(met)}: samples, x̂₀ and P₀ are projected "
        '(initial.constraints = "none" for unprojected ones)'
    )


def _given(
    section: InitialSection, model: mujoco.MjModel, space: Manifold, x0: Float[Array, " nx"]
) -> tuple[Float[Array, " nx"], Float[Array, "n n"]]:
    """x̂₀ and P₀.

    Raises:
        CovarianceError: P₀ is not positive semidefinite.
        DimensionError: the count of values or the shape of P₀ is wrong.
    """
    mean = x0.copy()
    blocks = {
        "qpos": slice(0, model.nq),
        "qvel": slice(model.nq, model.nq + model.nv),
        "act": slice(model.nq + model.nv, None),
    }
    for name, block in blocks.items():
        given = getattr(section, name)
        if given is not None:
            if len(given) != len(mean[block]):
                raise DimensionError(
                    f"initial.{name} has {len(given)} values; expected {len(mean[block])}"
                )
            mean[block] = given
    mean = space.plus(mean, np.zeros(space.n))  # unit quaternions
    if section.cov is None:
        std = expand(section.std, space.names, "initial.std")
        if not (std >= 0).all():
            worst = int(std.argmin())
            raise CovarianceError(
                f"initial.std is {std[worst]:g} for {space.names[worst]}; use a std of at least 0, "
                "0 for a coordinate that is known exactly (later patterns win)"
            )
        return mean, np.diag(std**2)
    return mean, datasheet.matrix(section.cov, space, "initial.cov", "P₀", definite=False)
