"""A model is tried before it is used: mistakes that give numbers without an error are found."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from estbench.errors import EstbenchError, ModelError
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.function import FunctionModel
from estbench.models.protocol import Model
from estbench.shapes import Array, Float
from estbench.spaces.manifold import Manifold


def probe(
    model: Model,
    mean: Float[Array, "run nx"],
    cov: Float[Array, "run n n"],
    u: Float[Array, "run nu"],
    times: Sequence[float],
) -> None:
    """Try the functions of a user's model about the prior, and any model against the times.

    Args:
        model: any model; those of a robot have no functions of the user.
        mean: x̂₀.
        cov: P₀.
        u: the first control.
        times: of the predictions, s.

    Raises:
        ModelError: a function draws random numbers, mixes the runs (as one written for one state
            does), or changes its argument; or the steps differ and the model ignores them.
    """
    x = spread(model.space, mean, cov)
    t, steps = times[0], np.diff(times)
    steps = steps[steps > 0]
    dt = float(steps[0]) if len(steps) else 1.0
    if isinstance(model, FunctionModel | ContinuousFunctionModel):
        for name, call in _functions(model, u, t, dt).items():
            probe_function(name, call, x)
    elif not type(model).__module__.startswith("estbench."):
        probe_function("transition", lambda p: model.transition(p, u, t, dt), x)
        probe_function("measurement", lambda p: model.measurement(p, u, t + dt), x)
    _repeats("Q", lambda: model.process_noise(x, u, t, dt))
    _repeats("R", lambda: model.measurement_noise(t + dt))
    if len(steps) and np.ptp(steps) > 1e-6 * steps.max():
        _uses_steps(model, x, u, t, float(steps.min()), float(steps.max()))


def probe_function(name: str, function: Callable[[Array], Any], x: Float[Array, "run nx"]) -> None:
    """Try a function of states: twice, with other states in the other runs, with several points.

    Args:
        name: of the function, for the message.
        function: takes x `(run, nx)`, and perhaps `(run, point, nx)`.
        x: states that differ between runs.

    Raises:
        ModelError: see `probe`.
    """
    given = x.copy()
    value = np.array(function(given))
    if not np.array_equal(given, x, equal_nan=True):
        raise ModelError(
            f"{name} changes its argument x in place, so that the belief changes with it; let it "
            "work on x.copy()"
        )
    _repeats(name, lambda: function(x.copy()), value)
    for row in {0, len(x) - 1}:
        alone = np.array(function(np.repeat(x[row : row + 1], len(x), axis=0)))
        if not _close(alone[row], value[row]):
            raise ModelError(
                f"{name} mixes the runs: its result for one of {len(x)} states depends on the "
                "others; a function written for one state needs batched=False, one for many "
                "indexes the last axis, x[..., i]"
            )
    points = np.stack([x, x[::-1], x], axis=1)
    try:
        several = np.array(function(points.copy()))
    except EstbenchError:  # where it is asked for points it says so itself
        return
    if several.shape[:2] == points.shape[:2] and not _close(several[:, 0], value):
        raise ModelError(
            f"{name} mixes the points (run, point, n) of a run: its result for one state depends "
            "on the others; index the last axis, x[..., i]"
        )


def spread(
    space: Manifold, mean: Float[Array, "run nx"], cov: Float[Array, "run n n"]
) -> Float[Array, "run nx"]:
    """States within 0.3 σ of the prior that differ from run to run."""
    std = np.sqrt(np.clip(np.diagonal(cov, axis1=-2, axis2=-1), 0.0, None))
    std = np.where(std > 0, std, 1e-6 * (1.0 + space.magnitude(mean)))
    pattern = np.cos(1.0 + np.arange(len(mean))[:, None] + 0.7 * np.arange(space.n))
    return space.plus(mean, 0.3 * std * pattern)


def _functions(
    model: FunctionModel | ContinuousFunctionModel, u: Array, t: float, dt: float
) -> dict[str, Callable[[Array], Array]]:
    """The user's functions by name, each as a function of x."""
    if isinstance(model, ContinuousFunctionModel):
        rate, slope = (lambda x: model.flow(x, u, t)), (lambda x: model.flow_jacobian(x, u, t)[1])
    else:
        rate = lambda x: model.transition(x, u, t, dt)  # noqa: E731
        slope = lambda x: model.transition_jacobian(x, u, t, dt)[1]  # noqa: E731
    out: dict[str, Callable[[Array], Array]] = {
        "f": rate, "h": lambda x: model.measurement(x, u, t + dt),
    }  # fmt: skip
    if model.f_jacobian is not None:
        out["f_jacobian"] = slope
    if model.h_jacobian is not None:
        out["h_jacobian"] = lambda x: model.measurement_jacobian(x, u, t + dt)[1]
    return out


def _repeats(name: str, call: Callable[[], Any], first: Any = None) -> None:
    """Refuse a function that gives another value when it is called again."""
    if not np.array_equal(call() if first is None else first, call(), equal_nan=True):
        raise ModelError(
            f"{name} gives another value when it is called again with the same arguments: it draws "
            "random numbers or keeps a state; let Q and R describe the noise"
        )


def _uses_steps(model: Model, x: Array, u: Array, t: float, short: float, long: float) -> None:
    """Refuse steps of two lengths where the model makes the same of them."""
    moved = [model.transition(x, u, t, dt) for dt in (short, long)]
    noise = [model.process_noise(x, u, t, dt) for dt in (short, long)]
    still = np.array_equal(moved[0], x) and not np.any(noise[0])  # it has nothing to scale
    alike = np.array_equal(moved[0], moved[1], equal_nan=True) and np.array_equal(
        noise[0], noise[1]
    )
    if not still and alike:
        raise ModelError(
            f"times has steps of {short:g} s and of {long:g} s, but {type(model).__name__} ignores "
            "dt: its transition and Q are those of one step; give evenly spaced times, leave them "
            "out to count steps, or use a model with f(x, u, t, dt)"
        )


def _close(a: Array, b: Array) -> bool:
    """Whether the values agree up to rounding."""
    return a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=1e-300, equal_nan=True)
