"""Which run each episode of each row is.

The episodes of a row that was seeded with s are the runs 0, 1, 2, ... of `estbench run --seed s`:
they have the same initial states, disturbances, parameters and noises.
"""

import numpy as np

from estbench.shapes import Ints


class Episodes:
    """Seed and number of the next run of each row.

    Args:
        rows: how many.
    """

    def __init__(self, rows: int):
        self._seeds: list[int | None] = [None] * rows
        self._runs = [0] * rows

    def seed(self, row: int, seed: int | None) -> None:
        """Seed a row; None takes fresh entropy, but only if the row has no seed yet."""
        if seed is None and self._seeds[row] is not None:
            return
        fresh = np.random.SeedSequence().generate_state(1, np.uint64)[0] if seed is None else seed
        self._seeds[row], self._runs[row] = int(fresh), 0

    def next(self, rows: Ints) -> tuple[list[int], list[int]]:
        """Seeds and numbers of the runs that begin now in some rows."""
        seeds, runs = [], []
        for row in rows.tolist():
            self.seed(row, None)
            seeds.append(self._seeds[row])
            runs.append(self._runs[row])
            self._runs[row] += 1
        return seeds, runs
