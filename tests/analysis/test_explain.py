"""Each rule speaks first on a scenario with just its fault, and none on one without a fault."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import estbench
from benchmarks.faults import FAULTS, named, store
from estbench.analysis.evidence import gather
from estbench.analysis.explain import explain, lost, noise, too_late, unexplained, unseen
from estbench.analysis.explanations import explanations, of
from estbench.analysis.load import load
from estbench.commands.cli import app
from estbench.errors import AnalysisError

RUNS = 24


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """The evidence about an EKF whose model is the true one, and its folder."""
    folder = tmp_path_factory.mktemp("matched") / "x"
    estbench.run("cartpole", ["ekf"], runs=RUNS, duration=1.0, out=folder)
    return gather(load(folder), "ekf"), folder


@pytest.mark.parametrize("fault", FAULTS)
def test_a_prepared_fault_is_named_first(fault, tmp_path):
    assert named(store(fault, tmp_path / "x", RUNS))[0] == FAULTS[fault][0]


def test_a_matched_filter_has_no_fault(matched):
    evidence, folder = matched
    assert explain(evidence) == []
    assert explanations(folder)[0].findings == ()


def changed(evidence, **record):
    """The evidence with some variables of the record in place of its own."""
    return replace(evidence, record={**evidence.record, **record})


def test_only_what_the_sensors_do_not_see_is_called_unseen(matched):
    evidence, _ = matched
    twice = changed(evidence, anees=2 * evidence.record["anees"])
    assert unseen(twice) is not None
    assert "hardly see" in unseen(twice).text
    assert [f.rule for f in explain(twice)] == ["unseen"]
    assert unseen(changed(twice, anis=2 * evidence.record["anis"])) is None
    assert unseen(evidence) is None


@pytest.mark.parametrize(
    ("size", "lag", "name"),
    [
        (2.0, 0.2, "Q too small"), (0.5, -0.2, "Q too large"), (2.0, -0.2, "R too small"),
        (0.5, 0.2, "R too large"), (2.0, 0.0, None),
    ],
)  # fmt: skip
def test_size_and_correlation_of_the_innovations_tell_q_from_r(matched, size, lag, name):
    evidence, _ = matched
    spread = 1e-3 * np.linspace(-1, 1, RUNS)
    found = noise(
        changed(
            evidence,
            anis=size * evidence.record["anis"],
            channel_nis=size * evidence.record["channel_nis"],
            lag_one=lag + spread,
        )
    )
    assert (found and found.rule) == name


def test_what_no_rule_explains_is_said_to_be_uncertain(matched):
    evidence, _ = matched
    odd = changed(
        evidence, anis=2 * evidence.record["anis"], lag_one=np.linspace(-1e-3, 1e-3, RUNS)
    )
    assert unexplained(odd) is not None
    assert "no cause is certain" in unexplained(odd).text
    assert explain(odd) == [unexplained(odd)]


def test_lost_runs_and_late_readings_are_counted(matched):
    evidence, _ = matched
    share = replace(evidence.summary.diverged_interval, value=0.1)
    summary = replace(evidence.summary, diverged_interval=share, late=3)
    assert "10% of 24 runs diverged" in lost(replace(evidence, summary=summary)).text
    assert "3 readings" in too_late(replace(evidence, summary=summary)).text
    assert lost(evidence) is None
    assert too_late(evidence) is None


def test_a_store_that_lacks_the_evidence_is_refused(matched):
    stored = load(matched[1])
    del stored.records["ekf"]["scaled_square"]
    with pytest.raises(AnalysisError, match=r"lacks scaled_square: it is of an earlier version"):
        of(stored, "ekf")
    with pytest.raises(AnalysisError, match=r"no estimator 'ukf' in .*; it has ekf"):
        of(stored, "ukf")
    stored = load(matched[1])
    stored.records["ekf"]["diverged"][1:] = True
    with pytest.raises(AnalysisError, match="1 runs of ekf did not diverge"):
        of(stored, "ekf")


def test_the_command(matched):
    runner = CliRunner()
    text = runner.invoke(app, ["explain", str(matched[1])])
    assert text.exit_code == 0
    assert "no fault shows" in text.output
    out = runner.invoke(app, ["explain", str(matched[1]), "-e", "ekf", "--json"])
    assert json.loads(out.output) == {"ekf": []}
