"""GTSAM's legged filter on our protocol. Skipped where GTSAM is not installed."""

import builtins

import numpy as np
import pytest

from estbench.errors import EstimatorError, MissingExtraError
from estbench.estimators import registry
from estbench.estimators.contact_inekf import ContactInEKF
from tests.legged import robot, xml

DT = 0.01


def test_without_gtsam_the_extra_is_named(monkeypatch):
    plain = builtins.__import__
    monkeypatch.setattr(
        "importlib.import_module",
        lambda name, *rest: (_ for _ in ()).throw(ImportError) if name == "gtsam" else plain(name),
    )
    from estbench.estimators.adapters import gtsam

    with pytest.raises(MissingExtraError, match="extra 'peers'"):
        gtsam.GtsamInEKF(robot(xml()))


def test_it_agrees_with_our_filter_and_does_not_go_back():
    """Standing on two feet, 60 readings: position, velocity and attitude within a fifth of σ.

    The two differ in the integration of a step, in the noise of a foot that comes down, and in the
    noise of the first steps.
    """
    pytest.importorskip("gtsam")
    model = robot(xml(), {"root.v?": 1e-4})
    theirs, ours = (registry.create(n, {}, model) for n in ("gtsam_inekf", "contact_inekf"))
    assert isinstance(ours, ContactInEKF)
    rest = np.concatenate([model.mjmodel.qpos0, np.zeros(model.mjmodel.nv)])
    x, P = (
        np.repeat(rest[None], 2, axis=0),
        np.diag(np.full(model.space.n, 1e-4))[None].repeat(2, 0),
    )
    rng, u = np.random.default_rng(0), np.zeros((2, 0))
    beliefs = [e.init(x, P) for e in (theirs, ours)]
    past = beliefs[0]
    for k in range(60):
        noise = rng.standard_normal((2, 12))
        y = np.concatenate([
            0.01 * noise[:, :3], [0.0, 0.0, 9.81] + 0.1 * noise[:, 3:6], 0.002 * noise[:, 6:],
            np.full((2, 2), 99.0),
        ], axis=1)  # fmt: skip
        for i, estimator in enumerate((theirs, ours)):
            ahead = estimator.predict(beliefs[i], u, k * DT, DT)
            beliefs[i], innovation = estimator.update(ahead, y, u, (k + 1) * DT)
            assert innovation.residual.shape == (2, 14)
        past = past if k else beliefs[0]
    base = np.r_[0:6, 12:15]
    error = model.space.minus(theirs.mean(beliefs[0]), ours.mean(beliefs[1]))[:, base]
    std = [
        np.sqrt(np.diagonal(e.cov(b), 0, 1, 2))[:, base] for e, b in zip((theirs, ours), beliefs)
    ]
    assert (np.abs(error) < 0.2 * std[1]).all()
    np.testing.assert_allclose(std[0], std[1], rtol=0.05)
    with pytest.raises(EstimatorError, match="cannot go back to an earlier belief"):
        theirs.predict(past, u, 0.0, DT)
    with pytest.raises(EstimatorError, match=r"gyro_bias is 0\.1; GTSAM's filter estimates no"):
        registry.create("gtsam_inekf", {"gyro_bias": 0.1}, model)
