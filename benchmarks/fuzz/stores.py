"""Stores with one file damaged: read, then resumed."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import estbench
from benchmarks.fuzz.case import Case
from estbench.analysis.compare import compare_stores
from estbench.analysis.formats import render
from estbench.errors import StoreError

KINDS = ("flip", "zero", "cut", "delete")


def run(out: Path, resume: bool = False) -> estbench.Results:
    """The store that is damaged: two batches, traces kept."""
    return estbench.run(
        "pendulum", ["ekf"], runs=10, duration=0.1, batch_size=5, out=out, resume=resume
    )


def files(folder: Path) -> list[Path]:
    """Every file of a store but its locks."""
    return sorted(
        p.relative_to(folder)
        for p in folder.rglob("*")
        if p.is_file() and not p.name.startswith(".lock")
    )


def cases(count: int, seed: int, whole: Path) -> Iterator[Case]:
    """Damages of a copy of the store `whole`."""
    names = files(whole)
    for i in range(count):
        rng = np.random.default_rng((seed, 5, i))
        name, kind = names[rng.integers(len(names))], KINDS[rng.integers(len(KINDS))]
        content = bytearray((whole / name).read_bytes())
        at = int(rng.integers(len(content)))
        if kind == "flip":
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == "zero":
            end = min(len(content), at + int(rng.integers(1, 17)))
            content[at:end] = bytes(end - at)
        elif kind == "cut":
            del content[at:]
        yield Case(f"{kind} {name} at {at}", _Damage(whole, name, kind, bytes(content)))


class _Damage:
    def __init__(self, whole: Path, name: Path, kind: str, content: bytes):
        self._whole, self._name, self._kind, self._content = whole, name, kind, content

    def __call__(self, folder: Path) -> str:
        store = folder / "x"
        shutil.copytree(self._whole, store)
        if self._kind == "delete":
            (store / self._name).unlink()
        else:
            (store / self._name).write_bytes(self._content)
        shutil.copytree(self._whole, folder / "whole" / "x")
        read = "read, the same"
        try:
            shown = render(compare_stores([store]), "json")
            assert shown.replace("whole/", "") == render(
                compare_stores([folder / "whole" / "x"]), "json"
            ).replace("whole/", ""), "another result is read"  # fmt: skip
        except StoreError as error:
            named = any(part in str(error) for part in (self._name.name, *self._name.parts[1:-1]))
            read = "refused by the reader" if named else f"not named by the reader: {error}"
        run(store, resume=True)
        again = {p: (store / p).read_bytes() for p in files(store) if p.parts[0] != "costs"}
        first = {p: (self._whole / p).read_bytes() for p in again}
        assert files(store) == files(self._whole), "other files"
        assert again == first, "it was not repaired"
        assert not read.startswith("not named"), read
        return f"{read}, repaired"
