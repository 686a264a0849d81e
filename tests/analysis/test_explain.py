"""Each rule speaks first on a scenario with just its fault, and none on one without a fault."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import estbench
from benchmarks.faults import FAULTS, named, store
from estbench.analysis.direct_causes import contact, latency, some_time, start
from estbench.analysis.evidence import gather
from estbench.analysis.explain import explain, failed, lost, too_late, undecided, unexplained
from estbench.analysis.explanations import explanations, of
from estbench.analysis.inferred_causes import noise, outliers, unseen
from estbench.analysis.load import load
from estbench.commands.cli import app
from estbench.consistency.summary import summarize
from estbench.consistency.verdict import Verdict, judge
from estbench.errors import AnalysisError
from estbench.scenario.channels import ChannelSection

RUNS = 24


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """The evidence about an EKF whose model is the true one, and its folder."""
    folder = tmp_path_factory.mktemp("matched") / "x"
    estbench.run("cartpole", ["ekf"], runs=RUNS, duration=1.0, out=folder)
    return gather(load(folder), "ekf"), folder


SOME = [*list(FAULTS)[:10:3], "contact"]  # all of them: python -m benchmarks.faults


@pytest.mark.parametrize("fault", SOME)
def test_a_prepared_fault_is_named_first(fault, tmp_path):
    assert named(store(fault, tmp_path / "x", RUNS))[0] == FAULTS[fault][0]


def test_a_matched_filter_has_no_fault(matched):
    evidence, folder = matched
    assert not evidence.refuted()
    few = explanations(folder)[0]
    assert [f.rule for f in few.findings] == ["undecided"]
    needed = evidence.summary.judgement.needed
    assert few.findings[0].remedy.startswith(f"more runs (`--runs {needed}`)")
    shown = replace(evidence.summary.judgement, verdict=Verdict.CONSISTENT, needed=None)
    assert explain(replace(evidence, summary=replace(evidence.summary, judgement=shown))) == []


def changed(evidence, **record):
    """The evidence with some variables of the record in place of its own, judged again."""
    record = {**evidence.record, **record}
    summary = replace(evidence.summary, judgement=judge(record))
    return replace(evidence, record=record, summary=summary)


def larger(evidence, blocks, factor=3.0):
    """The evidence with larger errors in some blocks."""
    nees = evidence.record["nees_by_block"].copy()
    nees[:, blocks] *= factor
    return changed(evidence, nees_by_block=nees)


def test_time_names_a_wrong_start_or_an_event(matched):
    evidence, _ = matched
    assert start(evidence) is some_time(evidence) is None
    first = start(larger(evidence, [0, 1]))
    assert first.text.startswith("P₀ is too small, or x̂₀ is wrong: NEES/n is")
    assert "wrong from 0.0 to 0.2 s" in first.text
    assert some_time(larger(evidence, [0, 1])) is None
    assert start(larger(evidence, [0, 1], 0.2)).text.startswith("P₀ is too large")
    later = some_time(larger(evidence, [4, 5]))
    assert "from 0.4 to 0.6 s only" in later.text
    assert start(larger(evidence, [4, 5])) is None


def test_one_coordinate_of_many_names_the_time(matched):
    evidence, _ = matched
    square = evidence.record["scaled_square"].copy()
    square[:, 6:8, 1] *= 6
    text = some_time(changed(evidence, scaled_square=square)).text
    assert text.startswith("the squared error of pole over its variance is up to")
    assert "from 0.6 to 0.8 s only" in text


def test_the_test_of_blocks_must_refute_before_a_time_is_named(matched):
    """Errors that are too large all the time are no event, though few blocks are refuted."""
    evidence, _ = matched
    some = larger(evidence, slice(None), 1.3)
    some = larger(some, [3, 4], 1.5)
    assert [h.block for h in some.refuted()]
    assert some_time(some) is None
    assert some_time(larger(evidence, [3, 4], 1.05)) is None


def test_contact_is_named_where_the_errors_begin_with_it(matched):
    evidence, _ = matched
    large = {"anees": 5 * evidence.record["anees"]}
    ones, spread = np.ones(RUNS), np.linspace(0.9, 1.1, RUNS)

    def found(before, since, event, elsewhere):
        phases = np.stack([elsewhere * spread, np.nan * ones, event * spread], axis=1)
        return contact(changed(
            evidence, **large, anees_by_phase=phases,
            phase_steps=np.tile([50, 0, 50], (RUNS, 1)),
            nees_around_contact=np.stack([before * spread, since * spread], axis=1),
        ))  # fmt: skip

    first, near = found(1, 5, 5, 5), found(np.nan, np.nan, 8, 2)
    assert " until the run comes within 3 steps of a touch-down or a lift-off" in first.text
    assert first.text.startswith("NEES/n is 1.0")
    assert "within 3 steps of a touch-down or a lift-off, and 2.0" in near.text
    assert "rotated_ukf" in first.remedy
    assert found(5, 5, 5, 5) is found(2, 5, 5, 5) is found(1, 1, 1, 1) is None
    assert contact(evidence) is contact(changed(evidence, **large)) is None


def test_latency_reads_the_filter_table_of_the_estimator(matched):
    evidence, _ = matched
    scenario = evidence.scenario.model_copy(deep=True)
    scenario.channels["pole_encoder"] = ChannelSection(latency=0.05)
    late = replace(larger(evidence, slice(None), 3.0), scenario=scenario)
    assert latency(late) is None
    scenario.estimators["ekf"] = {"filter": {"delays": "naive"}}
    assert "pole_encoder is 0.05 s late and taken as 0 s" in latency(late).text
    scenario.estimators["ekf"] = {"filter": {"channels": {"pole_encoder": {"latency": 0.02}}}}
    assert "pole_encoder is 0.05 s late and taken as 0.02 s" in latency(late).text
    assert latency(replace(evidence, scenario=scenario)) is None


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


def test_large_innovations_in_a_row_are_no_outliers(matched):
    evidence, _ = matched
    spread = 1e-3 * np.linspace(-1, 1, RUNS)
    for lag, name in ((-0.02, "outliers"), (0.0, "outliers"), (0.2, None)):
        found = outliers(replace(changed(evidence, lag_one=lag + spread), rare=(30.0, 0.7)))
        assert (found and found.rule) == name


def test_what_no_rule_explains_is_said_to_be_uncertain(matched):
    evidence, _ = matched
    odd = changed(
        evidence, anis=2 * evidence.record["anis"], lag_one=np.linspace(-1e-3, 1e-3, RUNS)
    )
    assert "no cause is certain" in unexplained(odd).text
    assert explain(odd) == [unexplained(odd)]


def test_every_refuted_hypothesis_is_reported(matched):
    """`explain` says nothing only where the verdict has nothing to say."""
    evidence, _ = matched
    rng = np.random.default_rng(1)
    for name in ("anees", "anis", "channel_nis", "nees_by_block", "scaled_square"):
        value = evidence.record[name]
        odd = changed(evidence, **{name: value * rng.uniform(3, 4, value.shape[1:])})
        assert odd.refuted()
        assert explain(odd)


def test_runs_and_readings_are_counted(matched):
    evidence, _ = matched
    judgement = replace(evidence.summary.judgement, lost=2, failed=4)
    summary = replace(evidence.summary, judgement=judgement, late=3)
    bad = replace(evidence, summary=summary)
    assert "2 of 20 runs diverged" in lost(bad).text
    assert "failed in 4 of 24 runs" in failed(bad).text
    assert "3 readings" in too_late(bad).text
    assert failed(evidence) is None
    assert lost(evidence) is too_late(evidence) is None
    judgement = replace(evidence.summary.judgement, verdict=Verdict.UNDECIDED, needed=None)
    open_ = replace(evidence, summary=replace(evidence.summary, judgement=judgement))
    assert undecided(open_).remedy.startswith("more runs, or")


def test_a_store_that_lacks_the_evidence_is_refused(matched):
    stored = load(matched[1])
    del stored.records["ekf"]["scaled_square"]
    with pytest.raises(AnalysisError, match=r"lacks scaled_square: it is of an earlier version"):
        of(stored, "ekf")
    with pytest.raises(AnalysisError, match=r"no estimator 'ukf' in .*; it has ekf"):
        of(stored, "ukf")


def test_an_estimator_that_loses_all_runs_is_explained(matched):
    stored = load(matched[1])
    record = stored.records["ekf"]
    record["diverged"][:] = True
    stored.summaries["ekf"] = summarize(
        "ekf", record, stored.runs.tolist(), stored.times, stored.scenario.consistency,
        stored.names, stored.channels,
    )  # fmt: skip
    found = of(stored, "ekf")
    assert found.verdict == "diverging"
    assert [f.rule for f in found.findings] == ["lost"]


def test_the_command(matched):
    runner = CliRunner()
    text = runner.invoke(app, ["explain", str(matched[1])])
    assert text.exit_code == 0
    assert "ekf: undecided" in text.output
    assert "runs would decide" in " ".join(text.output.split())
    out = runner.invoke(app, ["explain", str(matched[1]), "-e", "ekf", "--json"])
    said = json.loads(out.output)["ekf"]
    assert said["verdict"] == "undecided"
    assert said["reason"] == load(matched[1]).summaries["ekf"].reason
    assert [cause["rule"] for cause in said["causes"]] == ["undecided"]
