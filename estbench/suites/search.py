"""The search for a suite: greedy by information, and the cheapest of all that meet a requirement.

Information is monotone and submodular in the set of channels, so that k channels chosen one after
the other, each the one that adds most, have at least 1 - 1/e of the information of the best k
(Nemhauser, Wolsey & Fisher 1978). A variance falls with every channel; that is all the exhaustive
search takes for granted.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from itertools import combinations

import numpy as np

from estbench.shapes import Array, Float

MOST = 15
"""Candidates up to which all subsets are searched."""
BATCH = 64
"""Suites that are tried at once."""

Chosen = frozenset[str]
Measure = Callable[[Sequence[Chosen]], Float[Array, " suite"]]
"""A number for each of several suites."""
Meets = Callable[[Sequence[Chosen]], Sequence[bool]]
"""Whether each of several suites meets the requirement."""


def greedy(candidates: Sequence[str], measure: Measure) -> tuple[list[str], Float[Array, " k"]]:
    """The candidates in the order in which each adds most, and the measure after each.

    Args:
        candidates: names.
        measure: monotone and submodular, as the information is.
    """
    order: list[str] = []
    values = []
    while len(order) < len(candidates):
        left = [name for name in candidates if name not in order]
        found = measure([frozenset((*order, name)) for name in left])
        best = int(np.argmax(found))
        order.append(left[best])
        values.append(float(found[best]))
    return order, np.array(values)


def cheapest(candidates: Sequence[str], cost: Mapping[str, float], meets: Meets) -> Chosen:
    """The suite of least cost that meets a requirement; among equals that of fewest channels.

    Channels without which the requirement is not met are in every suite. The others are tried in
    the order of cost; no suite of which a larger one failed is tried.

    Args:
        candidates: at most `MOST`; all together meet the requirement.
        cost: of each, at least 0.
        meets: monotone: a suite that contains one which meets it meets it too.
    """
    every = frozenset(candidates)
    single = [frozenset(every - {name}) for name in candidates]
    needed = frozenset(n for n, fine in zip(candidates, meets(single)) if not fine)
    free = [name for name in candidates if name not in needed]
    subsets = [frozenset(c) for k in range(len(free) + 1) for c in combinations(free, k)]
    subsets.sort(key=lambda s: (sum(cost[n] for n in s), len(s), sorted(s)))
    failed: list[Set[str]] = []
    at = 0
    while at < len(subsets):
        batch: list[Chosen] = []
        while at < len(subsets) and len(batch) < BATCH:
            if not any(subsets[at] <= larger for larger in failed):
                batch.append(subsets[at])
            at += 1
        for chosen, fine in zip(batch, meets([needed | s for s in batch]) if batch else ()):
            if fine:
                return needed | chosen
            failed.append(chosen)
    return every


def pruned(order: Sequence[str], cost: Mapping[str, float], meets: Meets) -> Chosen:
    """A suite that meets a requirement: the first of an order that do, less those not needed.

    For more candidates than an exhaustive search can try. The dearest are left out first.

    Args:
        order: of the candidates, best first; all together meet the requirement.
        cost: of each.
        meets: monotone.
    """
    heads = [frozenset(order[:k]) for k in range(len(order) + 1)]
    chosen = heads[int(np.argmax(list(meets(heads))))]
    for name in sorted(chosen, key=lambda n: -cost[n]):
        if meets([chosen - {name}])[0]:
            chosen = chosen - {name}
    return chosen
