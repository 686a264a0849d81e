"""How often the verdict on a log is wrong: `python -m benchmarks.logs`.

Matched estimators on simulated runs, each of which is judged alone, as a log with truth is.
"""

import argparse
from collections import Counter
from dataclasses import fields, replace

import numpy as np

from estbench.consistency import innovations, parts
from estbench.experiment.setup import build
from estbench.inference.innovations import readings
from estbench.inference.traces import Traces
from estbench.logs.replay import series_of
from estbench.montecarlo.batch import traced
from estbench.scenario.load import resolve
from estbench.shapes import Array
from estbench.tables.columns import Table, tabulate
from estbench.tables.writers import text

CASES = (("pendulum", 10.0), ("cartpole", 20.0))
FIRST = ("lags", "lag_terms", "fault", "fault_step", "late")
"""Fields of traces of which the runs are the first axis; of the others they are the second."""


def one_run(traces: Traces, run: int) -> Traces:
    """The traces of one run of several."""
    changes: dict[str, Array] = {}
    for field in fields(traces):
        value = getattr(traces, field.name)
        if hasattr(value, "ndim"):
            changes[field.name] = value[[run]] if field.name in FIRST else value[:, [run]]
    return replace(traces, **changes)


def table(runs: int) -> Table:
    """Verdicts, and how often the interval of NEES/n holds 1."""
    rows = []
    for name, duration in CASES:
        scenario = resolve(name, ["ekf"], runs=runs, duration=duration)
        prepared = build(scenario)
        ((label, traces),) = traced(prepared, range(runs), True, True)
        assert traces is not None
        times, section = prepared.times, scenario.consistency
        settled = (times > section.burn_in) & (times > 0)
        verdicts, inside, counts = Counter[str](), 0, list[int]()
        for run in range(runs):
            alone = one_run(traces, run)
            series = series_of(alone, settled)
            most = parts.most_parts(alone, settled)
            sample = parts.of_log(alone, times, settled, False, series, most)
            white = innovations.by_part(series, innovations.parts(np.arange(len(series.nis))))
            summary = parts.summarize_log(
                label, sample, white, times, section, prepared.space.names,
                tuple(prepared.channel_spaces), readings(prepared.channel_spaces), True,
            )  # fmt: skip
            verdicts[str(summary.verdict)] += 1
            inside += summary.anees.low <= 1 <= summary.anees.high
            counts.append(len(sample["anees"]))
        wrong = runs - verdicts["consistent"] - verdicts["undecided"]
        rows.append([
            name, f"{duration:g}", str(runs), f"{min(counts)} to {max(counts)}",
            str(verdicts["consistent"]), str(verdicts["undecided"]), f"{wrong / runs:.1%}",
            f"{inside / runs:.1%}",
        ])  # fmt: skip
    headings = (
        "<robot", "s", "logs", "parts", "consistent", "undecided", "refuted", "NEES/n holds 1",
    )  # fmt: skip
    note = "5% may be refuted; 95% of the intervals should hold 1"
    return tabulate("matched EKF, each run judged as a log with truth", headings, rows, note)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="of each robot")
    print(text([table(parser.parse_args().runs)]))
