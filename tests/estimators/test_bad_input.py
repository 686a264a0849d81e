"""One line naming the estimator, the setting, the value and the remedy, whatever is wrong."""

import sys

import numpy as np
import pytest

from estbench.commands import cli
from estbench.errors import DimensionError, EstbenchError, EstimatorError
from estbench.estimators import registry
from estbench.experiment import setup
from estbench.models.continuous import ContinuousFunctionModel
from estbench.models.function import FunctionModel
from estbench.montecarlo import run as experiment
from tests.helpers import linear_model, random_cov

MODEL = linear_model(0)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("ukf", {"alpha": 0.0}, r"UKF: alpha is 0.0; use a number in \(0, 1\]"),
        ("ukf", {"alpha": -1}, r"UKF: alpha is -1; use a number in \(0, 1\]"),
        ("sr_ukf", {"alpha": 0.0}, r"SquareRootUKF: alpha is 0.0; use a number in \(0, 1\]"),
        ("ghkf", {"order": 1}, "GHKF: order is 1; use "),
        ("rotated_ukf", {"omega": -0.1}, r"RotatedUKF: omega is -0.1; use a number in \[0, inf\]"),
        ("rotated_ukf", {"centre_weight": 1}, "RotatedUKF: centre_weight is 1; use a number below"),
        ("rotated_ukf", {"centre_weight": float("-inf")}, "RotatedUKF: centre_weight is -inf; use"),
        ("rotated_ukf", {"centre_weight": True}, "RotatedUKF: centre_weight is True; use a number"),
        ("rotated_ukf", {"rotations": 0}, "RotatedUKF: rotations is 0; use an integer of at least"),
        ("bias_ukf", {"base": "ekf"}, "BiasUKF: base is 'ekf'; use one of ukf, .* or your own as"),
        ("enkf", {"size": 1}, "EnKF: size is 1; use an integer of at least 2"),
        ("enkf", {"size": 100.0}, "EnKF: size is 100.0; use an integer"),
        ("enkf", {"form": "sqrt"}, "EnKF: form is 'sqrt'; use one of stochastic, deterministic"),
        ("enkf", {"inflation": 0.9}, r"EnKF: inflation is 0.9; use a number in \[1, inf\]"),
        ("pf", {"size": 1}, "ParticleFilter: size is 1; use an integer of at least 2"),
        ("pf", {"threshold": 1.5}, r"ParticleFilter: threshold is 1.5; use a number in \[0, 1\]"),
        ("pf", {"regularization": -1.0}, "ParticleFilter: regularization is -1.0; use a number"),
        ("imm", {"switching": 2.0}, r"IMM: switching is 2.0; use a number in \[0, 1\]"),
        ("imm", {"process_noise_scales": [1.0, -1.0]}, "IMM: process_noise_scales is .* list"),
        ("imm", {"transition": [[1.0]]}, r"IMM: transition has shape \(1, 1\); use \(2, 2\)"),
        ("imm", {"transition": [[1.0, 1.0], [0.0, 1.0]]}, "IMM: transition is .* with sum 1"),
        ("imm", {"base": "ekff"}, "no estimator 'ekff' .did you mean"),
        ("robust_ekf", {"method": "hubr"}, "RobustEKF: method is 'hubr'; use one of gate_compo"),
        ("robust_ekf", {"gate": 0.0}, r"RobustEKF: gate is 0.0; use a number in \(0, 1\]"),
        ("robust_ekf", {"iterations": 0}, "RobustEKF: iterations is 0; use an integer"),
        ("adaptive_ekf", {"window": 1}, "AdaptiveEKF: window is 1; use an integer of at least 2"),
        ("adaptive_ekf", {"fading": 0.5}, r"AdaptiveEKF: fading is 0.5; use a number in \[1, inf"),
        ("adaptive_ekf", {"inflation": 0.5}, "AdaptiveEKF: inflation is 0.5; use numbers of at le"),
        ("adaptive_ekf", {"adapt": "P"}, "AdaptiveEKF: adapt is 'P'; use one of none, R, Q, both"),
        ("schmidt_ekf", {"considered": ["z"]}, "SchmidtEKF: considered: 'z' matches none"),
        ("bias_ekf", {"bias": {"z": 1.0}}, "BiasEKF: bias: 'z' matches none"),
        ("bias_ekf", {"bias": -1.0}, "BiasEKF: bias of y0: std is -1.0; use a number of at least"),
        ("bias_ekf", {"bias": 1.0, "walk": 1.0, "time_constant": 1.0}, "BiasEKF: .* give one of"),
        ("converted_ekf", {"range": "y0"}, "ConvertedEKF: range is 'y0' and bearing None"),
        ("converted_ekf", {"range": "y0", "bearing": "q"}, "ConvertedEKF: bearing is 'q'; there"),
        (
            "iekf",
            {"iterations": 0},
            "IEKF: iterations is 0; use an integer of at least 1 and at mo",
        ),
        ("iekf", {"iterations": 2.5}, "IEKF: iterations is 2.5; use an integer of at least 1 and"),
        ("ekf", {"covariance_update": "best"}, "EKF: covariance_update is 'best'; use one"),
        ("lkf", {"handover_time": -1.0}, r"LKF: handover_time is -1.0; use a number in \[0, inf"),
        (
            "kf",
            {"u0": [1.0, 2.0]},
            r"KF: u0 is \[1.0, 2.0\]; use 1 finite numbers, one per control",
        ),
        ("cd_ekf", {}, "ContinuousDiscreteEKF: LinearModel has no method 'flow'; use a continuous"),
        ("iplf", {"base": "ekf"}, "IPLF: base is 'ekf'; use one of ukf, ckf, ghkf, rotated_ukf"),
        ("iplf", {"iterations": 0}, "IPLF: iterations is 0; use an integer of at least 1 and at"),
        ("iplf", {"tolerance": -1.0}, r"IPLF: tolerance is -1.0; use a number in \[0, inf\]"),
        ("iplf", {"settings": {"alpha": 2.0}}, "UKF: alpha is 2.0; use a number"),
        ("iplf", {"settings": {"redraw": False}}, "IPLF: redraw is false; leave it out of the se"),
        ("diplf", {"iterations": -1}, "DIPLF: iterations is -1; use an integer of at least 1"),
        ("diplf", {"measurement_iterations": 0}, "DIPLF: measurement_iterations is 0; use an int"),
        ("diplf", {"settings": {"centre_weight": -1}}, "DIPLF: a weight of the points of rotated"),
        ("ipls", {"base": "rts"}, "IPLS: base is 'rts'; use one of iplf, ukf, ckf, ghkf, rotated"),
        ("ipls", {"iterations": 0}, "IPLS: iterations is 0; use an integer of at least 1"),
        ("ipls", {"tolerance": True}, "IPLS: tolerance is True; use a number"),
        ("rts", {"base": "pf"}, "RTS: base is 'pf'; use one of ekf"),
        ("rts", {"base": 3}, "RTS: base is 3; use one of ekf"),
        ("rts", {"settings": "joseph"}, "RTS: settings is 'joseph'; use a table of settings"),
        (
            "ghkf",
            {"order": 101},
            "GHKF: order is 101; use an integer of at least 2 and at most 100",
        ),
        ("sr_ukf", {"kappa": -3.0}, "SquareRootUKF: kappa is -3.0; .* use a value above -3"),
        ("filterpy_ukf", {"kappa": -3.0}, "FilterPyUKF: kappa is -3.0; .* use a value above -3"),
        ("stonesoup_ukf", {"kappa": -3.0}, "StoneSoupUKF: kappa is -3.0; .* use a value above -3"),
        (
            "schmidt_ekf",
            {"considered": "x0"},
            "SchmidtEKF: considered is 'x0'; use a list of names",
        ),
        ("bias_ekf", {"considered": "bias"}, "BiasEKF: considered is 'bias'; use a list of names"),
        (
            "bias_ekf",
            {"bias": "big"},
            "BiasEKF: bias is 'big'; use a number, a list of numbers, or",
        ),
        ("bias_ukf", {"settings": 3}, "BiasUKF: settings is 3; use a table of settings"),
        (
            "imm",
            {"process_noise_scales": []},
            r"IMM: process_noise_scales is \[\]; use a list of pos",
        ),
        ("imm", {"transition": "often"}, "IMM: transition is 'often'; use rows of numbers"),
        ("imm", {"settings": 3}, "IMM: settings is 3; use a table of settings"),
        ("imm", {"base": 3}, "estimator 3 is no name; use one of `estbench list`"),
        (
            "converted_ekf",
            {"position": "xy"},
            "ConvertedEKF: position is 'xy'; use a list of names",
        ),
        (
            "converted_ekf",
            {"origin": [0.0]},
            r"ConvertedEKF: .* origin \[0.0\]; give two names and t",
        ),
    ],
)
def test_a_setting_out_of_range(name, settings, message):
    with pytest.raises(EstbenchError, match=message) as error:
        registry.create(name, settings, MODEL)
    assert len(str(error.value).splitlines()) == 1


def continuous(**settings):
    return ContinuousFunctionModel(
        lambda x, u, t: -x, lambda x, u, t: x[..., :1], np.eye(2), np.eye(1), **settings
    )


@pytest.mark.parametrize("name", ["ekf", "iekf", "sr_ekf", "lkf", "kf", "rts"])
@pytest.mark.parametrize(
    ("functions", "message"),
    [
        ({"f_jacobian": lambda x, u, t, dt: np.eye(3)},
         r"f_jacobian returned shape \(3, 3\); expected \(2, 2, 2\)"),
        ({"h_jacobian": lambda x, u, t: np.ones((2, 1))},
         r"h_jacobian returned shape \(2, 1\); expected \(2, 1, 2\)"),
        ({"f": lambda x, u, t, dt: x[..., :1]}, r"f returned shape \(2, .*1\); expected"),
        ({"h": lambda x, u, t: x}, r"h returned shape \(2, .*2\); expected"),
    ],
)  # fmt: skip
def test_a_function_or_jacobian_of_the_wrong_shape(name, functions, message):
    given = {"f": lambda x, u, t, dt: x, "h": lambda x, u, t: x[..., :1], **functions}
    model = FunctionModel(Q=np.eye(2), R=np.eye(1), **given)
    estimator = registry.create(name, {}, model)
    belief = estimator.init(np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)))
    u = np.zeros((2, 0))
    with pytest.raises(DimensionError, match=message) as error:
        estimator.update(estimator.predict(belief, u, 0.0, 0.1), np.zeros((2, 1)), u, 0.1)
    assert len(str(error.value).splitlines()) == 1


def test_a_continuous_jacobian_of_the_wrong_shape():
    model = continuous(f_jacobian=lambda x, u, t: np.eye(3))
    estimator = registry.create("cd_ekf", {}, model)
    belief = estimator.init(np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)))
    with pytest.raises(DimensionError, match="f_jacobian returned shape"):
        estimator.predict(belief, np.zeros((2, 0)), 0.0, 0.1)


@pytest.mark.parametrize("name", ["ekf", "ukf", "kf", "enkf", "pf", "sr_ekf", "sr_ukf"])
def test_a_prior_of_the_wrong_shape(name):
    cov = random_cov(np.random.default_rng(0), 3)
    with pytest.raises(DimensionError, match=r"mean has shape \(2, 3\) and cov \(3, 3\); expected"):
        registry.create(name, {}, MODEL).init(np.zeros((2, 3)), cov)


@pytest.mark.parametrize("name", ["ekf", "ukf", "kf", "enkf", "pf", "sr_ekf", "sr_ukf"])
@pytest.mark.parametrize(("nx", "n"), [(5, 5), (4, 3), (1, 4)])
def test_a_prior_that_does_not_fit_the_model(name, nx, n):
    model = linear_model(0, n=4)
    message = rf"mean has shape \(2, {nx}\) and cov \(2, {n}, {n}\); .* nx = 4 and n = 4"
    with pytest.raises(DimensionError, match=message):
        registry.create(name, {}, model).init(np.zeros((2, nx)), np.tile(np.eye(n), (2, 1, 1)))


def test_a_noise_gain_of_the_wrong_shape():
    parts = (lambda x, u, t, dt: x, lambda x, u, t: x[..., :1], np.eye(1), np.eye(1))
    with pytest.raises(DimensionError, match=r"noise_gain has shape \(2, 2\); expected \(n, 1\)"):
        FunctionModel(*parts, noise_gain=np.eye(2))
    with pytest.raises(DimensionError, match="n_states is 0; give the count of states"):
        FunctionModel(*parts, noise_gain=lambda x, u, t, dt: np.ones((2, 1)))
    model = FunctionModel(*parts, noise_gain=lambda x, u, t, dt: np.ones((3, 1)), n_states=2)
    with pytest.raises(DimensionError, match=r"noise_gain returned shape \(3, 1\); expected"):
        model.process_noise(np.zeros((1, 2)), np.zeros((1, 0)))


def test_a_window_longer_than_the_run():
    for override, message in (
        ("estimators.a={type='adaptive_ekf', window=31}", "a: window is 31 arrivals but the run "),
        ("estimators.a={type='map', window=0.5}", "a: window is 0.5 s but the run only 0.3 s"),
        ("estimators.a={type='ekf', start={method='batch', window=0.5}}", "a: start.window is 0.5"),
    ):
        resolved = experiment.resolve("pendulum", duration=0.3, overrides=[override])
        with pytest.raises(EstimatorError, match=message):
            setup.build(resolved)


USER = """
import numpy as np
from estbench.estimators.ekf import EKF

class Lacking:
    def __init__(self, model): ...
    def init(self, mean, cov): ...
    def predict(self, belief, u, t, dt): ...

class Flat(EKF):
    def cov(self, belief):
        return belief.cov[:, 0]

class Single(EKF):
    def update(self, belief, y, u, t, channels=None, mask=None):
        return belief

class Short(EKF):
    def smooth(self, history):
        return history.beliefs[1:]
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Lacking", "estimator '{0}:Lacking' lacks the method(s) update, mean, cov; an estimator "
                    "has init, predict, update, mean, cov"),
        ("Flat", "Flat: mean has shape (3, 2) and cov (3, 2); expected (3, 2) and (3, 2, 2)"),
        ("Single", "Single: update returned Gaussian; return a pair, the belief and an Innovation"),
        ("Short", "Short: smooth returned 10 beliefs; expected 11, one per time and one"),
        ("Missing", "estimator '{0}:Missing': module {0} has no 'Missing'"),
    ],
)  # fmt: skip
def test_a_users_estimator_that_is_wrong(name, message, tmp_path, monkeypatch, capsys):
    module = f"user_{tmp_path.name}"
    (tmp_path / f"{module}.py").write_text(USER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    words = ["run", "pendulum", "-e", f"{module}:{name}", "--runs", "2", "--duration", "0.1"]
    monkeypatch.setattr(sys, "argv", ["estbench", *words])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message.format(module) in line
