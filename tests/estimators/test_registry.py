import importlib
import inspect
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from estbench.commands import catalogue
from estbench.errors import EstimatorError
from estbench.estimators import names, registry
from estbench.estimators.ekf import EKF
from estbench.estimators.protocol import Estimator
from estbench.estimators.ukf import UKF
from tests.helpers import DISCRETE, linear_model

MODEL = linear_model(0)
JOSEPH_ONLY = {"robust_ekf", "adaptive_ekf", "schmidt_ekf"}

USER = """
class Good:
    def __init__(self, model, gain=1.0):
        self.model, self.gain = model, gain
        if gain == 13:
            raise ValueError("unlucky\\nnumber")
    def init(self, mean, cov): ...
    def predict(self, belief, u, t, dt): ...
    def update(self, belief, y, u, t, channels=None, mask=None): ...
    def mean(self, belief): ...
    def cov(self, belief): ...

class Open(Good):
    def __init__(self, model, **settings):
        self.settings = settings

class Lacking(Good):
    cov = None
    predict = None

value = 3
"""


@pytest.fixture
def user(tmp_path, monkeypatch):
    """The name of a module of the user's in the current folder."""
    name = f"user_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(USER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return name


@pytest.mark.parametrize("name", DISCRETE)
def test_every_registered_estimator_can_be_built_and_follows_the_protocol(name):
    assert isinstance(registry.create(name, {}, MODEL), Estimator)


def test_known_and_resolve():
    assert registry.resolve("ekf") is EKF
    assert registry.resolve("ukf") is UKF
    assert registry.resolve("estbench.estimators.ekf:EKF") is EKF
    assert set(names.BUILTIN) <= set(names.known())


def test_the_label_is_the_type_unless_one_is_given():
    assert isinstance(registry.create("ekf", {}, MODEL), EKF)
    filter = registry.create("mine", {"type": "ukf", "alpha": 0.5, "redraw": False}, MODEL)
    assert isinstance(filter, UKF)
    assert (filter.alpha, filter.redraw) == (0.5, False)


def test_settings_are_not_consumed():
    settings = {"type": "ekf"}
    registry.create("a", settings, MODEL)
    assert settings == {"type": "ekf"}


@pytest.mark.parametrize(
    ("label", "settings", "message"),
    [
        ("ekff", {}, r"no estimator 'ekff' \(did you mean .*'ekf'"),
        ("a", {"type": "zzz"}, r"no estimator 'zzz' \(known: .*ekf.*ukf"),
        ("a", {"type": "ukf", "alfa": 1.0}, r"a: no setting 'alfa' \(did you mean 'alpha'"),
        ("ekf", {"rule": 1}, "ekf: no setting 'rule'"),
        ("ukf", {"rule": 1}, "ukf: no setting 'rule'"),  # a field, but not a setting
        ("ekf", {"model": 1}, "ekf: no setting 'model'"),
        (
            "ekf",
            {"covariance_update": "jo"},
            "EKF: covariance_update is 'jo'; use one of joseph, s",
        ),
        ("ukf", {"alpha": 0.0}, r"UKF: alpha is 0.0; use a number in \(0, 1\]"),
        ("ukf", {"alpha": 1.5}, r"UKF: alpha is 1.5; use a number in \(0, 1\]"),
        ("ukf", {"alpha": float("nan")}, "UKF: alpha is nan"),
        ("ukf", {"alpha": "big"}, "UKF: alpha is 'big'; use a number"),
        ("ukf", {"alpha": True}, "UKF: alpha is True; use a number"),
        ("ukf", {"beta": -1.0}, r"UKF: beta is -1.0; use a number in \[0, inf"),
        ("ukf", {"beta": float("inf")}, "UKF: beta is inf"),
        ("ukf", {"kappa": -3.0}, "UKF: kappa is -3.0; n .* positive, so use a value above -3"),
        ("ukf", {"kappa": float("nan")}, "UKF: kappa is nan"),
        ("ukf", {"kappa": float("inf")}, "kappa is inf"),
        ("ukf", {"kappa": "big"}, "kappa"),
        ("ukf", {"redraw": "no"}, "redraw is 'no'"),
    ],
)
def test_bad_names_and_settings(label, settings, message):
    with pytest.raises(EstimatorError, match=message):
        registry.create(label, settings, MODEL)


@pytest.mark.parametrize(
    "good", [{"alpha": 1}, {"alpha": 1e-3}, {"beta": 0}, {"kappa": -2.9}, {"redraw": False}]
)
def test_settings_at_the_edge_of_their_range(good):
    assert np.isfinite(registry.create("ukf", good, MODEL).rule.cov_weights).all()


def test_a_users_class(user):
    filter = registry.create("mine", {"type": f"{user}:Good", "gain": 2.0}, MODEL)
    assert (filter.model, filter.gain) == (MODEL, 2.0)
    with pytest.raises(EstimatorError, match=r"no setting 'gian' \(did you mean 'gain'"):
        registry.create("mine", {"type": f"{user}:Good", "gian": 2.0}, MODEL)


def test_a_users_class_that_takes_any_setting(user):
    filter = registry.create("mine", {"type": f"{user}:Open", "gain": 2.0}, MODEL)
    assert filter.settings == {"gain": 2.0}


def test_a_users_class_that_lacks_methods(user):
    with pytest.raises(
        EstimatorError, match=r"lacks the method\(s\) predict, cov; an estimator has"
    ):
        registry.resolve(f"{user}:Lacking")
    with pytest.raises(EstimatorError, match="lacks the method"):
        registry.resolve(f"{user}:value")


def test_a_users_class_that_raises(user):
    with pytest.raises(EstimatorError, match=r"mine: .*:Good.* raised ValueError: unlucky"):
        registry.create("mine", {"type": f"{user}:Good", "gain": 13}, MODEL)


def test_a_module_without_the_class(user):
    with pytest.raises(EstimatorError, match=f"module {user} has no 'Goood'"):
        registry.resolve(f"{user}:Goood")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1/0", "cannot import 'broken_{}': ZeroDivisionError: division by zero"),
        ("def f(:", "cannot import 'broken_{}': SyntaxError"),
        ("import not_installed_anywhere", "ModuleNotFoundError: No module named 'not_installed_an"),
    ],
)
def test_a_module_that_raises(text, message, user, tmp_path):
    name = f"broken_{len(text)}"
    (tmp_path / f"{name}.py").write_text(text)
    with pytest.raises(EstimatorError, match=message.format(len(text))):
        registry.resolve(f"{name}:Anything")


@pytest.mark.parametrize("name", ["no_such_module_here:A", ":A", "estbench.estimators.ekf:"])
def test_a_module_that_is_not_there(name):
    with pytest.raises(EstimatorError, match=f"estimator '{name}'"):
        registry.resolve(name)


def test_an_installed_packages_entry_point(tmp_path, monkeypatch):
    """A distribution that is nothing but its metadata and one module."""
    text = USER.replace("class Good:", "class Good:\n    'Theirs.'")
    (tmp_path / "their_filters.py").write_text(text)
    info = tmp_path / "their_filters-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-filters\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[estbench.estimators]\ntheirs = their_filters:Good\nbroken = nothing_there:Good\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert names.known()["theirs"] == "their_filters:Good"
    filter = registry.create("theirs", {"gain": 2.0}, MODEL)
    assert (filter.model, filter.gain) == (MODEL, 2.0)
    with pytest.raises(EstimatorError, match=r"no estimator 'their' .did you mean 'theirs'"):
        registry.resolve("their")
    with pytest.raises(EstimatorError, match="estimator 'broken': cannot import 'nothing_there'"):
        registry.resolve("broken")
    listed = catalogue.catalogue()["estimators"]
    assert listed["theirs"] == "Theirs."
    assert listed["broken"].startswith("cannot be imported: ModuleNotFoundError")


def test_every_registered_name_is_a_class_with_a_first_line():
    for name, line in catalogue.catalogue()["estimators"].items():
        assert line.endswith((".", ":", ",")) or len(line) > 20, name
        assert not line.startswith("cannot be imported"), name


def documented():
    """Names in the page's first table, and (name, setting, default) of each row of its second."""
    page = (Path(__file__).parents[2] / "docs" / "estimators.md").read_text(encoding="utf-8")
    described, settings = set(), []
    for line in page.splitlines():
        if line.startswith("| `"):
            first, *rest = (cell.strip() for cell in line.strip("|").split("|"))
            if len(rest) < 2:  # the methods of an estimator
                continue
            second, third = rest[:2]
            names = re.findall("`([^`]+)`", first)
            if re.fullmatch("`[a-z_0]+`", second):
                settings += [(name, second.strip("`"), third) for name in names]
            else:
                described |= set(names)
    return described, settings


def shown(default):
    """A default as the page writes it; None where it is put in words."""
    if isinstance(default, bool | str):
        return f"`{str(default).lower() if isinstance(default, bool) else default}`"
    return f"`{default:g}`" if isinstance(default, int | float) else None


def test_every_estimator_is_documented_with_its_settings_and_their_defaults():
    described, settings = documented()
    assert described == set(names.BUILTIN)
    for name, target in names.BUILTIN.items():
        module, _, attribute = target.partition(":")
        signature = inspect.signature(getattr(importlib.import_module(module), attribute))
        real = {p: shown(v.default) for p, v in signature.parameters.items() if p != "model"}
        if name in JOSEPH_ONLY:
            del real["covariance_update"]
        page = {setting: default for owner, setting, default in settings if owner == name}
        assert page.keys() == real.keys(), name
        for setting, default in real.items():
            assert default in (None, page[setting]), (name, setting)


@pytest.mark.parametrize("name", sorted(JOSEPH_ONLY))
def test_a_form_that_would_not_be_used_is_refused(name):
    with pytest.raises(EstimatorError, match="covariance_update is 'simplified'; use one of jos"):
        registry.create(name, {"covariance_update": "simplified"}, MODEL)
