"""CSV files of controls, some of them broken."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

import estbench
from benchmarks.fuzz.case import Case

CELLS = ("nan", "inf", "-inf", "", "x", "1e400", "=1", " ", "1,5", "\x00", "9" * 10**7, "ü", '"')


def cases(count: int, seed: int) -> Iterator[Case]:
    """Tables of the cart-pole's control; each has one flaw, or none."""
    for i in range(count):
        rng = np.random.default_rng((seed, 3, i))
        rows = [[f"{0.01 * k:g}", f"{rng.standard_normal():.3g}"] for k in range(6)]
        kind, at = int(rng.integers(9)), int(rng.integers(6))
        head = ["t", "force"]
        flaw = "none"
        if kind == 0:
            cell = CELLS[rng.integers(len(CELLS))]
            flaw, rows[at][rng.integers(2)] = f"cell {cell[:8]!r}", cell
        elif kind == 1 and at:
            flaw, rows[at][0] = "falling time", rows[at - 1][0]
        elif kind == 2:
            flaw, head = "swapped headings", ["force", "t"]
        elif kind == 3:
            flaw, rows[at] = "short row", rows[at][:1]
        elif kind == 4:
            flaw, rows[at] = "long row", [*rows[at], "1"]
        elif kind == 5:
            flaw, rows = "no rows", []
        elif kind == 6:
            flaw, head = "a heading too few", ["t"]
        elif kind == 7:
            flaw, head = "no headings", []
        text = "\n".join(",".join(row) for row in (*([head] if head else []), *rows))
        data = text.encode()
        if kind == 8:
            flaw, data = "bytes", bytes(rng.integers(0, 256, 200, dtype=np.uint8))
        fine = flaw in ("none", "no headings")
        yield Case(f"CSV {i}: {flaw} at {at}", _Run(data), not fine)


class _Run:
    def __init__(self, data: bytes):
        self._data = data

    def __call__(self, folder: Path) -> str:
        path = folder / "u.csv"
        path.write_bytes(self._data)
        changes = ["control.kind=csv", f"control.path={path}"]
        results = estbench.run("cartpole", "ekf", runs=2, duration=0.05, overrides=changes)
        return str(results["ekf"].verdict)
