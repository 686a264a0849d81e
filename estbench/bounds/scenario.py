"""The bound of a scenario: what it knows of the truth, and which unknowns it has.

It knows the true robot, the true disturbance and R, and the controls, as given from outside. It
does not know x₀, the disturbance, the noise and the errors of the sensors, and the parameters that
are drawn in each run, unless `bound = "known"`.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import block_diag

from estbench.bounds.expectation import Reading, follow
from estbench.bounds.linearization import Linearization, Linearized
from estbench.bounds.sensor_errors import WithSensorErrors, errors
from estbench.experiment.prepared import Setup
from estbench.models.differences import Differences
from estbench.robots import backend, parameters
from estbench.robots.model import MujocoModel, SensorChannel
from estbench.robots.varied import Parameter, VariedBackend
from estbench.sensors.delivery import Delivery
from estbench.shapes import Array, Float
from estbench.simulation.sources import Trajectory
from estbench.spaces.linalg import is_positive_definite
from estbench.spaces.semidefinite import psd_root

CLOSED = ("lqr", "user")
"""Controllers whose control depends on the state."""
RUNS = 32
"""The bound is an expectation over the first runs of an experiment, those with a smaller number. It
depends on the run much less than a squared error does, and costs as much as an extended filter."""
CHANGE = 1e-4
"""Of a drawn parameter, in standard deviations, for the derivative with respect to it."""


def obstacle(setup: Setup) -> str | None:
    """Why the scenario has no bound, or None if it has one."""
    exact = [c.name for c in setup.channels if not is_positive_definite(c.cov)]
    if exact:
        return f"{', '.join(exact)} without white noise: a reading has no finite information"
    if setup.seen:
        return "sensors see the disturbance, which tells them more than of the state"
    return None


def wanted(setup: Setup) -> bool:
    """Whether the bound is to be computed, and exists."""
    return bool(setup.scenario.bound) and obstacle(setup) is None


def notices(setup: Setup) -> list[str]:
    """Why there is no bound although it is wanted, and what it takes for granted."""
    if not setup.scenario.bound:
        return []
    if why := obstacle(setup):
        return [f"no bound and no efficiency: {why}"]
    control = setup.scenario.control
    if control.observe == "truth" and control.kind in CLOSED:
        return [
            "the controller sees the true state; the bound counts the control as given from "
            "outside, so that it knows nothing of the state from it"
        ]
    return []


def bound_of_runs(
    setup: Setup,
    runs: Sequence[int],
    happened: Trajectory,
    stop: Callable[[], bool] = lambda: False,
) -> Float[Array, "time run n"] | None:
    """Numbers whose mean over the runs is the bound on each coordinate's mean square error.

    Only runs with a number below `RUNS` have one, however they are batched.

    Args:
        setup: the experiment.
        runs: their numbers.
        happened: in these runs.
        stop: asked at every instant; True ends it.

    Returns:
        (unit)²; NaN for a later run and one with states that are not finite, and for all from the
        time on at which no run has finite Jacobians. None when stopped. See
        `recursion.Variations.values`.
    """
    n, few = setup.space.n, [place for place, run in enumerate(runs) if run < RUNS]
    out = np.full((len(setup.times), len(runs), n), np.nan)
    if not few:
        return out
    x, u = happened.x[:, few], happened.u[:, few]
    system, factor = true_system(setup, [runs[place] for place in few])
    jacobian = beginning(setup, factor, x[0])
    read = readings(setup, happened.deliveries, few)
    for k, variations in enumerate(follow((factor, jacobian), system, setup.times, x, u, read)):
        if stop():
            return None
        out[k, few] = variations.values()[:, :n]
    return out


def beginning(
    setup: Setup, factor: Float[Array, "k k"], x0: Float[Array, "run nx"]
) -> Float[Array, "run k k"]:
    """The Jacobian of the unknowns at the start: that of x₀ is in the tangent at the true state."""
    jacobian, n = (
        np.broadcast_to(np.eye(len(factor)), (len(x0), *factor.shape)).copy(),
        setup.space.n,
    )
    jacobian[:, :n, :n] = setup.space.reset_jacobian(setup.space.minus(x0, setup.mean))
    return jacobian


def readings(
    setup: Setup, deliveries: Sequence[Sequence[Delivery]], places: Sequence[int]
) -> list[Reading]:
    """What arrived in the runs at some places, each with the index of the time of its taking."""
    index = {instant.tick: k for k, instant in enumerate(setup.instants, 1)}
    return [
        Reading(index[d.taken], k, d.channels, None if d.mask is None else d.mask[places])
        for k, arrived in enumerate(deliveries, 1)
        for d in arrived
    ]


def true_system(setup: Setup, runs: Sequence[int]) -> tuple[Linearized, Float[Array, "k k"]]:
    """The true robots of some runs, and a square root of the covariance of what is unknown."""
    blocks = [psd_root(setup.cov)]
    draws, known = setup.scenario.truth.draw, setup.scenario.bound == "known"
    seed = setup.scenario.simulation.seed
    normals = {key: parameters.normals(key, seed, runs) for key in draws}
    varied = []
    for key in () if known else draws:
        varied.append(true_model(setup, {**normals, key: normals[key] + CHANGE}))
        blocks.append(np.eye(1))
    system: Linearized = Linearization(true_model(setup, normals), varied, CHANGE)
    if any(c.imperfections is not None for c in setup.channels):
        system = WithSensorErrors(
            system, setup.channels, [e for c in setup.channels for e in errors(c)]
        )
        blocks.append(np.diag(system.std))
    return system, np.asarray(block_diag(*blocks), np.float64)


def true_model(setup: Setup, normals: dict[str, Float[Array, "run 1"]]) -> MujocoModel:
    """The true robots as a model, with the parameters that these standard normals give."""
    plant, section = setup.plant, setup.scenario.filter
    channels = [
        SensorChannel(c.name, -1, c.cov, None if c.schedule is None else c.schedule.at, c.measurand)
        for c in setup.channels
    ]
    own = []
    for key, z in normals.items():
        draw = setup.scenario.truth.draw[key]
        spread = draw.relative_std, draw.std
        own.append(Parameter(*parameters.of_normals(plant.model, key, spread, z)))
    engine = VariedBackend(backend.create(plant.model), own) if own else None
    differences = Differences(section.differences, section.step)
    return MujocoModel(
        plant.model, channels, setup.disturbance, differences, u0=plant.u0, engine=engine
    )
