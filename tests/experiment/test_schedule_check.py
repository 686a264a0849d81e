"""An estimator may refuse a run that is too short for its settings."""

from dataclasses import dataclass

import pytest

from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.experiment import setup
from estbench.montecarlo import run as experiment


@dataclass(frozen=True)
class Patient(EKF):
    settling: float = 0.5

    def check_schedule(self, duration, arrivals, given):
        if "settling" in given and self.settling > duration:
            raise EstimatorError(f"settling takes {self.settling:g} s, the run {duration:g} s")
        assert arrivals == 10


class Broken(EKF):
    def check_schedule(self, duration, arrivals, given):
        raise KeyError("rate")


def build(kind, **settings):
    own = "".join(f", {name}={value}" for name, value in settings.items())
    override = f"estimators.a={{type='{__name__}:{kind}'{own}}}"
    return setup.build(experiment.resolve("pendulum", duration=0.1, overrides=[override]))


def test_a_users_estimator_is_asked():
    build("Patient")
    build("Patient", settling=0.1)
    with pytest.raises(EstimatorError, match=r"^a: settling takes 0\.2 s, the run 0\.1 s$"):
        build("Patient", settling=0.2)


def test_a_start_from_the_first_readings_does_not_hide_it():
    build("Patient", settling=0.1, start="{method='batch', window=0.05}")
    with pytest.raises(EstimatorError, match=r"^a: settling takes"):
        build("Patient", settling=0.2, start="{method='batch', window=0.05}")


def test_one_that_fails_is_named():
    with pytest.raises(EstimatorError, match=r"^a: check_schedule raised KeyError"):
        build("Broken")


def test_only_a_window_that_is_given_is_compared():
    resolved = experiment.resolve("pendulum", "adaptive_ekf", duration=0.05)  # default 30 arrivals
    setup.build(resolved)
