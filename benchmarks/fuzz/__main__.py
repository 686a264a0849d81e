"""Hostile inputs by the hundred: `python -m benchmarks.fuzz` (an hour; `--only` for parts).

Each case runs in a process of its own. Wanted: no traceback, no hang, no death by a signal; what is
accepted although a value of it is wild is listed, to be judged. Every damaged store is repaired by
--resume or refused by the name of the file; a run that is killed and resumed leaves the same bytes.
A case is repeated by its number: `--only scenarios
--first 17 --count 1`.
"""

import argparse
import itertools
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.fuzz import calls, controls, kills, models, scenarios, stores
from benchmarks.fuzz.case import Case, attempt

COUNTS = {"scenarios": 1000, "models": 200, "controls": 100, "calls": 200, "stores": 200,
          "kills": 20}  # fmt: skip
MAKERS: dict[str, Callable[[int, int], Iterator[Case]]] = {
    "scenarios": scenarios.cases, "models": models.cases, "controls": controls.cases,
    "calls": calls.cases,
}  # fmt: skip
BAD = ("traceback", "hang", "died")


def main() -> None:
    """Try the cases, and say what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=COUNTS, default=list(COUNTS))
    parser.add_argument("--count", type=int, help="of each kind; default as the issue asks")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    os.environ.pop("ESTBENCH_TRUST", None)
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.only:
            count = args.count or COUNTS[kind]
            total = args.first + count
            if kind == "stores":
                whole = Path(folder) / "whole"
                stores.run(whole)
                made = stores.cases(total, args.seed, whole)
            elif kind == "kills":
                made = kills.cases(total, args.seed, Path(folder) / "uninterrupted")
            else:
                made = MAKERS[kind](total, args.seed)
            bad += _try(kind, itertools.islice(made, args.first, None), args.first)
    raise SystemExit(bool(bad))


def _try(kind: str, cases: Iterator[Case], first: int) -> int:
    """Try the cases of a kind; how many went wrong."""
    outcomes: Counter[str] = Counter()
    nonsense = []
    for i, case in enumerate(cases, first):
        outcome = attempt(case)
        outcomes[outcome.kind] += 1
        if outcome.kind in BAD:
            print(f"{kind} {i} {outcome.kind.upper()}: {case.name}\n{outcome.text}", flush=True)
        elif outcome.kind == "accepted" and case.nonsense:
            nonsense.append(f"{kind} {i} accepted: {case.name} -> {outcome.text}")
    print("\n".join(nonsense))
    print(f"{kind}: {', '.join(f'{n} {what}' for what, n in outcomes.most_common())}", flush=True)
    return sum(outcomes[what] for what in BAD)


if __name__ == "__main__":
    main()
