"""From a validated scenario to the objects of an experiment: models, sensors, schedule, noise."""

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np

from estbench.consistency.records import RESERVED
from estbench.errors import (
    CovarianceError,
    EstbenchError,
    EstimatorError,
    ScenarioError,
    user_error_location,
)
from estbench.estimators.of_state import OfState
from estbench.estimators.protocol import ScheduleCheck
from estbench.experiment import believed as believing
from estbench.experiment import build as resolution
from estbench.experiment import size, starts
from estbench.experiment.prepared import Setup
from estbench.experiment.trial import try_estimator
from estbench.inference import initialization as starting
from estbench.inference.priors import checked_prior
from estbench.robots import flags, layout, mjcf, parameters
from estbench.scenario import believed as own
from estbench.scenario import reference
from estbench.scenario.filter import BelievedChannelSection, FilterSection
from estbench.scenario.schema import ControlSection, Scenario, StartSection
from estbench.sensors import channel as sensors
from estbench.sensors import kit, timing
from estbench.simulation import controllers

LEAK = (
    "the controller sees the true state: its controls tell the estimators where the robot is, and "
    'errors towards its set point are rewarded; control.observe="reference" compares fairly'
)


def build(scenario: Scenario) -> Setup:
    """Resolve a scenario.

    Raises:
        ScenarioError, DimensionError, CovarianceError, EstimatorError, ControllerError: a part of
            the scenario is wrong; raised before the simulation.
    """
    scenario = reference.settled(scenario)
    spec = mjcf.read(scenario.model.path)
    size.check_steps(scenario, spec)
    scenario, undeclared = resolution.declared(scenario, spec)
    section, belief = scenario.model, scenario.filter
    spec, truth = resolution.robot(scenario, spec)
    space = layout.state_space(truth)
    duration = scenario.simulation.duration
    channels, notices = sensors.build(
        truth,
        scenario.channels,
        scenario.sensors,
        section.frame_skip,
        duration,
        resolution.mjcf_timings(spec, truth),
        belief.channels,
    )
    if undeclared:
        used = kit.summary([c for c in channels if c.name in undeclared])
        notices.append(f"no sensor declared; using {used} (sensors = [] for none)")
    flags.leave_out_sensors(truth, {i for c in channels for i in c.measurand.sensors})
    # MuJoCo would saturate the true reading, before the noise; a sensor does so after it.
    truth.sensor_cutoff[np.isfinite(sensors.mjcf_cutoff(truth))] = 0.0
    x0, u0 = mjcf.keyframe(truth, section.keyframe)
    notices += resolution.rest_mocap(truth, section.keyframe)
    initial, mean, cov = starts.build(scenario, truth, space, x0, notices)
    instants = timing.instants(
        [(c.name, c.timing) for c in channels], truth.opt.timestep, section.frame_skip, duration
    )
    notices += resolution.silent(channels, instants[-1])
    burn_in, end = scenario.consistency.burn_in, instants[-1].end
    if not math.isclose(end, duration, rel_tol=1e-9):
        period = section.frame_skip * truth.opt.timestep
        notices.append(
            f"a duration of {duration:g} s was asked for, {end:g} s are run: whole control periods "
            f"of {period:g} s"
        )
    if burn_in >= end:
        raise ScenarioError(
            f"consistency.burn_in is {burn_in:g} s, which leaves nothing of a run of {end:g} s; "
            "shorten it or raise simulation.duration"
        )
    disturbance = resolution.disturbance(scenario.process_noise, truth, space, duration, notices)
    resolution.note_defaults(scenario, truth, notices)
    notices += flags.notes(spec)
    plant = controllers.Plant(truth, space, x0, u0, section.frame_skip)
    notices += controllers.clamped(scenario.control, plant)
    if scenario.control.kind in controllers.CLOSED_LOOP and scenario.control.observe == "truth":
        notices.append(LEAK)
    setup = Setup(
        scenario=scenario,
        plant=plant,
        channels=tuple(channels),
        instants=instants,
        disturbance=disturbance,
        shared=believing.build(scenario, belief, truth, channels, instants, disturbance),
        believed={},
        initial=initial,
        mean=mean,
        cov=cov,
        notices=tuple(notices),
    )
    setup = replace(setup, reference=_reference(setup))
    for key, draw in scenario.truth.draw.items():
        parameters.check_draw(truth, key, draw.relative_std, draw.std)
    resolution.watched(scenario, truth)
    setup.controller([0])
    return _with_estimators(setup)


def variant(setup: Setup, scenario: Scenario) -> Setup:
    """The experiment of a scenario whose truth and readings are those of another.

    It shares the true robot, sensors and schedule, and costs no compilation of a model.

    Args:
        setup: of the other scenario.
        scenario: differs from that of `setup` in `[filter]`, `[start]`, `[estimators]` and
            `[consistency]` only.

    Raises:
        EstbenchError: as `build`.
    """
    truth, section = setup.plant.model, scenario.filter
    shared = setup.shared
    if section != setup.scenario.filter:
        shared = believing.build(
            scenario, section, truth, setup.channels, setup.instants, setup.disturbance,
            like=setup.shared,
        )  # fmt: skip
    return _with_estimators(replace(setup, scenario=scenario, shared=shared))


def counted(setup: Setup, runs: int) -> Setup:
    """The same experiment with another count of runs, on which nothing else in it depends."""
    scenario = setup.scenario
    simulation = scenario.simulation.model_copy(update={"runs": runs})
    return replace(setup, scenario=scenario.model_copy(update={"simulation": simulation}))


def _with_estimators(setup: Setup) -> Setup:
    """The experiment with what each estimator of its scenario believes; all are checked."""
    scenario, shared = setup.scenario, setup.shared
    believed = {}
    for label in scenario.estimators:
        if label in RESERVED or not re.fullmatch(r"(?!__)\w[\w.+-]*", label):
            raise ScenarioError(
                f"estimators: the label '{label}' cannot name a group of results; use letters, "
                f"digits, '.', '-', '+' or '_', but not {', '.join(sorted(RESERVED))}"
            )
        section = own.believed(scenario, label)
        believed[label] = shared
        if section != shared.section:
            believed[label] = believing.build(
                scenario, section, setup.plant.model, setup.channels, setup.instants,
                setup.disturbance, f"estimators.{label}.filter", shared,
            )  # fmt: skip
    setup = replace(setup, believed=believed)
    for label in scenario.estimators:
        estimator = setup.estimator(label)
        size.check_estimator(setup, label, _inner(estimator))
        _check_lengths(setup, label, estimator)
        prior = setup.prior(label)
        checked_prior(*(a[None] for a in prior), setup.space)
        model = setup.model(believed=believed[label])
        try_estimator(label, estimator, model, prior, setup.plant.u0, setup.instants[0])
        _check_window(setup, label)
    return setup


def _reference(setup: Setup) -> Setup | None:
    """The experiment of the reference estimator: the true model, the prior of the truth.

    Raises:
        EstimatorError: it looks back.
        CovarianceError: it would take a channel for exact.
        EstbenchError: it cannot be built.
    """
    scenario, control = setup.scenario, setup.scenario.control
    if control.observe != "reference" or control.kind not in controllers.CLOSED_LOOP:
        return None
    for channel in setup.channels:
        if not np.diag(channel.cov).all():
            raise CovarianceError(
                f"channels.{channel.name}.noise is 0, and the reference estimator takes the true "
                'R, which must be positive definite; use a std above 0, or control.observe="truth"'
            )
    parts = {
        "filter": FilterSection(),
        "start": StartSection(),
        "estimators": {reference.LABEL: control.estimator},
        "control": ControlSection(),
    }
    made = variant(setup, scenario.model_copy(update=parts))
    if hasattr(made.estimator(reference.LABEL), "smooth"):
        raise EstimatorError(
            f"control.estimator is {control.estimator}, a smoother, which looks back; name a filter"
        )
    return made


def _check_window(setup: Setup, label: str) -> None:
    """Refuse a latency that is longer than the window of exact handling."""
    section, timestep = setup.believed[label].section, float(setup.plant.model.opt.timestep)
    delays = setup.delays(label)
    if section.window is None or delays.handling != "exact":
        return
    for channel in setup.channels:
        belief = section.channels.get(channel.name, BelievedChannelSection())
        late = channel.timing.latency * timestep if belief.latency is None else belief.latency
        if late > delays.window * timestep + 1e-9:
            raise ScenarioError(
                f"filter.window is {section.window:g} s but channel '{channel.name}' is {late:g} s "
                "late: it would never be fused; raise the window"
            )


def _inner(estimator: Any) -> Any:
    """The estimator of the scenario, without what starts it or takes a part of its state."""
    while isinstance(estimator, starting.WarmStart | OfState):
        estimator = estimator.estimator
    return estimator


def _check_lengths(setup: Setup, label: str, estimator: Any) -> None:
    """Refuse windows that are longer than the run.

    Raises:
        EstimatorError: `start.window` or a setting of the estimator needs a longer run.
    """
    end = setup.instants[-1].end
    start = setup.start(label)
    if start.method != "prior" and start.window >= end:
        raise EstimatorError(
            f"{label}: start.window is {start.window:g} s but the run only {end:g} s; shorten it"
        )
    inner = _inner(estimator)
    if not isinstance(inner, ScheduleCheck):
        return
    arrivals = sum(bool(i.channels) for i in setup.instants)
    try:
        inner.check_schedule(end, arrivals, frozenset(setup.settings(label)))
    except EstbenchError as error:
        raise EstimatorError(f"{label}: {error}") from None
    except (Exception, SystemExit) as error:  # a user's estimator may raise anything
        raise EstimatorError(
            f"{label}: check_schedule raised {user_error_location(error)}"
        ) from None
