"""A matched EKF on every bundled scenario and example: `python -m benchmarks.matched`.

The filter's model is the true one, with the sensor errors that it cannot know as states. It must be
refuted nowhere, but for the scenarios of `EXEMPT`.
"""

import argparse
from pathlib import Path

from estbench.consistency.verdict import Verdict
from estbench.montecarlo.run import run
from estbench.scenario.files import bundled
from estbench.scenario.load import load
from estbench.tables.quantity import quantity

EXAMPLES = Path(__file__).parents[1] / "examples"
LABELS = {"cartpole_bias": "bias_ekf", "sensor_bias": "bias_ekf"}
"""Scenario -> the estimator that knows of the biases; elsewhere `ekf`."""
CONTACT = "contact: the transition has kinks, of which a derivative at the mean does not know"
EXEMPT = {
    "ant": CONTACT, "half_cheetah": CONTACT, "hopper": CONTACT, "biped": CONTACT,
    "quadruped": CONTACT,
    "outliers": "outliers, which R does not describe: the filter is not matched",
    "wrong_start": "a start that is wrong on purpose: the filter is not matched",
}  # fmt: skip
"""Scenario -> why an EKF may be refuted there."""
NOT_REFUTED = (Verdict.CONSISTENT, Verdict.UNDECIDED)


def scenarios() -> dict[str, Path]:
    """All that are bundled and all examples, by name."""
    paths = [*bundled().values(), *sorted(EXAMPLES.rglob("*.toml"))]
    return {load(path).name: path for path in paths if path.name != "pyproject.toml"}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--duration", type=float, help="s, at most; default that of the scenario")
    parser.add_argument("--only", nargs="*", help="names of scenarios; default all")
    args = parser.parse_args()
    print("| scenario | estimator | runs | NEES/n | verdict | what is refuted, or why exempt |")
    print("|---|---|---:|---:|---|---|")
    wrong = 0
    for name, path in scenarios().items():
        if args.only and name not in args.only:
            continue
        label = LABELS.get(name, "ekf")
        duration = load(path).simulation.duration
        results = run(
            path, [label], runs=args.runs, duration=min(duration, args.duration or duration),
            overrides=["bound=false"], keep="summary",
        )  # fmt: skip
        found = results[label]
        refuted = found.verdict not in NOT_REFUTED
        wrong += refuted and name not in EXEMPT
        why = f"{found.reason} ({EXEMPT[name]})" if name in EXEMPT else found.reason
        cells = name, f"`{label}`", str(found.runs), quantity(found.anees), str(found.verdict), why
        print(f"| {' | '.join(cells)} |", flush=True)
    print(f"\n{wrong} refuted without an exemption")


if __name__ == "__main__":
    main()
