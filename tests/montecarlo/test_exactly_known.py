"""Robots of which a coordinate is known exactly: actuators with a state, joints without noise."""

import numpy as np
import pytest

import estbench
from estbench.consistency.verdict import Verdict
from estbench.estimators.beliefs import Fault

ROBOT = """
<mujoco>
  <option timestep="0.002"/> {extension}
  <worldbody>
    <body><joint name="j" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body> {body}
  </worldbody>
  <actuator> {actuator} </actuator>
  <sensor><jointpos name="enc" joint="j" noise="0.01"/></sensor>
</mujoco>"""
LAG = '<general name="m" joint="j" dyntype="filterexact" dynprm="0.001" gainprm="1"/>'
PARTS = {
    "filterexact": {"actuator": LAG},
    "filter": {
        "actuator": '<general name="m" joint="j" dyntype="filter" dynprm="0.01" gainprm="1"/>'
    },
    "integrator": {
        "actuator": '<general name="m" joint="j" dyntype="integrator" gainprm="1"/>'
    },
    "muscle": {
        "actuator": '<muscle name="m" joint="j" ctrlrange="0 1" range="0.75 1.05" '
        'lengthrange="-1 1" force="5"/>'
    },
    "dcmotor": {
        "actuator": '<dcmotor name="m" joint="j" motorconst="0.05" resistance="1" '
        'inductance="0.001"/>'
    },
    "pid": {
        "actuator": '<plugin joint="j" name="m" plugin="mujoco.pid" instance="p" actdim="1"/>',
        "extension": '<extension><plugin plugin="mujoco.pid"><instance name="p">'
        '<config key="kp" value="4"/><config key="ki" value="4"/><config key="kd" value="0.5"/>'
        "</instance></plugin></extension>",
    },
    "slide": {
        "body": '<body pos="1 0 0"><joint name="k" axis="1 0 0" type="slide" damping="20"/>'
        '<geom size="0.1" mass="0.1"/></body>'
    },
}  # fmt: skip
KNOWN = {"filterexact": "m.act", "filter": "m.act", "slide": "k.vel"}
SINE = ["control.kind=sine", "control.amplitude=0.5", "control.frequencies=[2.0]"]


def simulate(tmp_path, name, estimators, *overrides, runs=6, duration=0.4):
    path = tmp_path / "robot.xml"
    path.write_text(ROBOT.format(**{"extension": "", "body": "", "actuator": "", **PARTS[name]}))
    return estbench.run(
        str(path), estimators, runs=runs, duration=duration, workers=1,
        overrides=['process_noise.density={"*"=0.0, "j.vel"=0.01}', *overrides],
    )  # fmt: skip


@pytest.mark.parametrize("name", PARTS)
def test_a_robot_with_an_actuator_that_has_a_state_gets_a_verdict(tmp_path, name):
    """No run fails. The muscle's activation is cut at 0, so that the EKF may diverge."""
    estimators = ["ekf", "ukf", "sr_ekf", "sr_ukf", "rts"]
    results = simulate(tmp_path, name, estimators, *(SINE if name == "filterexact" else ()))
    for label in estimators:
        summary = results[label]
        assert not summary.failures
        assert summary.verdict is not Verdict.DIVERGING or name == "muscle"
        assert np.isfinite(summary.anees.value)
        known = {n for n, share in zip(results.names, summary.known) if share > 0}
        assert known == ({KNOWN[name]} if name in KNOWN else set())
    if name in KNOWN:
        said = " ".join(str(results).split())
        assert f"note: ekf, ukf, sr_ekf, sr_ukf: {KNOWN[name]} is known exactly in" in said or (
            f"note: ekf, ukf, sr_ekf, sr_ukf, rts: {KNOWN[name]} is known exactly in" in said
        )
        assert results.to_dict()["estimators"]["ekf"]["known_exactly"].keys() == {KNOWN[name]}


def test_nees_of_the_others_is_consistent(tmp_path):
    """1.00 ± 0.07 over 60 runs; outside of 0.75 to 1.25 with probability below 1e-6; seeded."""
    results = simulate(tmp_path, "filterexact", ["ekf"], *SINE, runs=60)
    assert results["ekf"].anees.value == pytest.approx(1.0, abs=0.25)
    assert 2.0 < results["ekf"].rank < 2.2


def test_a_wrong_claim_of_exact_knowledge_is_caught(tmp_path):
    """The filter's lag is 1.1 ms: its actuator's state is wrong by 1e-3, and known exactly."""
    results = simulate(
        tmp_path, "filterexact", ["ekf", "ukf"], *SINE, 'filter.set={"actuator_dynprm.m"=0.0011}',
        duration=0.7,
    )  # fmt: skip
    for label in ("ekf", "ukf"):
        assert results[label].diverged == 1.0
        assert results[label].verdict is Verdict.DIVERGING


def test_an_exact_start_is_no_error(tmp_path):
    results = simulate(tmp_path, "integrator", ["ekf", "ukf", "enkf"], 'initial.std={"*"=0.0}')
    for summary in results.summaries:
        assert not summary.failures
    assert results["ekf"].anees.value == pytest.approx(results["ukf"].anees.value, rel=1e-3)


class Indefinite(estbench.EKF):
    """Its covariance has a negative eigenvalue."""

    def cov(self, belief):
        P = belief.cov.copy()
        P[:, 0, 0] = -1e-3 * P[:, 0, 0]
        return P


def test_an_indefinite_covariance_is_a_failure_with_its_name(tmp_path):
    results = simulate(tmp_path, "filter", [f"{__name__}:Indefinite"])
    (summary,) = results.summaries
    assert {f.reason for f in summary.failures} == {Fault.COVARIANCE.text}
    assert len(summary.failures) == 6
    assert "the state covariance P is not positive semidefinite" in str(results)
