"""Every candidate that was computed, in memory and on disk: a search that is resumed repeats none.

Searches are deterministic: common random numbers, seeded generators. One that is begun again asks
for the same candidates in the same order, finds them here, and goes on where it was stopped.
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from estbench.errors import StoreError
from estbench.tuning.evaluation import Evaluate, Evaluation, Values, stacked

ARRAYS = ("log_likelihood", "mse", "anees", "diverged")


class Memory:
    """An `Evaluate` that computes each candidate once.

    Args:
        evaluate: computes candidates.
        folder: where they are kept; None keeps them in memory only.

    Attributes:
        asked: the candidates in the order in which they were first asked for.
        sets: how many sets of candidates there were with one that was not known.
    """

    def __init__(self, evaluate: Evaluate, folder: Path | None = None):
        self._evaluate, self._folder = evaluate, folder
        self._known: dict[Values, Evaluation] = {}
        self.names, self.runs = evaluate.names, evaluate.runs
        self.asked: list[Values] = []
        self.sets = 0
        self._files = 0
        self._stored: dict[Values, Evaluation] = {}
        if folder is not None:
            self._read(folder)

    def __call__(self, candidates: Sequence[Values]) -> Evaluation:
        """What the candidates give; those that are not known are computed as one set."""
        self.sets += any(values not in self._known for values in candidates)
        for values in candidates:
            if values in self._stored and values not in self._known:
                self._known[values] = self._stored[values]
                self.asked.append(values)
        new = [v for v in dict.fromkeys(candidates) if v not in self._known]
        if new:
            found = self._evaluate(new)
            self._write(new, found)
            for i, values in enumerate(new):
                self._known[values] = found.rows([i])
                self.asked.append(values)
        return stacked([self._known[values] for values in candidates])

    def _read(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for file in sorted(folder.glob("*.npz")):
            self._files = max(self._files, int(file.stem) + 1)
            try:
                with np.load(file) as stored:
                    values = json.loads(str(stored["values"]))
                    reasons = tuple(json.loads(str(stored["reasons"])))
                    arrays = [stored.get(name) for name in ARRAYS]
            except (OSError, ValueError, KeyError, EOFError, BadZipFile):
                continue  # damaged: computed again
            ll, mse, anees, diverged = arrays
            if ll is None or ll.shape[1] != self.runs:
                raise StoreError(f"{folder} is of a tuning with other runs; choose another --out")
            found = Evaluation(ll, mse, anees, diverged, reasons)
            for i, value in enumerate(values):
                self._stored[tuple(value)] = found.rows([i])

    def _write(self, values: Sequence[Values], found: Evaluation) -> None:
        if self._folder is None:
            return
        contents: dict[str, Any] = {
            "values": json.dumps([list(v) for v in values]),
            "reasons": json.dumps(found.reasons),
            **{name: a for name in ARRAYS if (a := getattr(found, name)) is not None},
        }
        path = self._folder / f"{self._files:05}.npz"
        draft = path.with_suffix(".partial")
        try:
            with draft.open("wb") as file:
                np.savez(file, **contents)
            os.replace(draft, path)
        except OSError as error:
            raise StoreError(
                f"{path} cannot be written: {error.strerror}; free the disk and --resume"
            ) from None
        self._files += 1
