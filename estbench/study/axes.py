"""The varied keys of a study with their values: lists, ranges, and designs of points."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.stats import qmc

from estbench.errors import StudyError
from estbench.spaces.patterns import is_number
from estbench.study import keys

Sample = Literal["sobol", "latin"]
MOST = 100_000
"""Variants of a study; each is a scenario with results of its own."""
FORMS = "a list 0.1,1,10, lin:LOW:HIGH:COUNT or log:LOW:HIGH:COUNT"


@dataclass(frozen=True)
class Axis:
    """One varied key.

    Attributes:
        names: the parts of the key.
        values: those it takes: on a grid each once, in a design one per point.
        log: whether its values are spread on a log scale.
    """

    names: keys.Names
    values: tuple[Any, ...]
    log: bool = False

    @property
    def key(self) -> str:
        """Its name as a dimension."""
        return keys.show(self.names)


@dataclass(frozen=True)
class Range:
    """`lin:LOW:HIGH[:COUNT]` or `log:LOW:HIGH[:COUNT]`; `at` maps [0, 1] to [low, high]."""

    low: float
    high: float
    log: bool
    count: int | None = None

    def at(self, shares: Sequence[float]) -> tuple[float, ...]:
        """The values at some shares of the way from low to high."""
        ends = np.array([self.low, self.high])
        low, high = np.log(ends) if self.log else ends
        points = low + (high - low) * np.asarray(shares, dtype=np.float64)
        inner = np.exp(points) if self.log else points
        # The ends themselves, not exp(log(·)) of them.
        ends = [np.equal(shares, 0), np.equal(shares, 1)]
        exact = np.select(ends, [self.low, self.high], inner)
        return tuple(exact.tolist())


def parse(text: str) -> tuple[keys.Names, Range | tuple[Any, ...]]:
    """`KEY=SPEC` of the command line.

    Raises:
        StudyError: it has another form, or its range is empty.
    """
    key, equals, spec = text.partition("=")
    if not equals or not spec.strip():
        raise StudyError(f"--over {text!r} is not of the form KEY=SPEC; SPEC is {FORMS}")
    names = keys.parse(key)
    form, *numbers = spec.strip().split(":")
    if form in ("lin", "log"):
        return names, _range(keys.show(names), form, numbers)
    if numbers and all(map(is_number, (form, *numbers))):
        spec = spec.strip()
        raise StudyError(f"--over {text!r}: a range names its scale; use lin:{spec} or log:{spec}")
    values = _values(spec.strip())
    _check_values(keys.show(names), values)
    return names, values


def grid(specs: Sequence[tuple[keys.Names, Range | Sequence[Any]]]) -> tuple[Axis, ...]:
    """One axis per key, of all its values.

    Raises:
        StudyError: a key is named twice, or a range has no count.
    """
    _check_once(specs)
    out = []
    sizes = [spec.count or 1 if isinstance(spec, Range) else len(spec) for _, spec in specs]
    _check_size(math.prod(sizes))
    for names, spec in specs:
        if isinstance(spec, Range):
            if spec.count is None:
                raise StudyError(
                    f"'{keys.show(names)}': the range has no count; use "
                    f"{'log' if spec.log else 'lin'}:{spec.low:g}:{spec.high:g}:COUNT"
                )
            shares = np.linspace(0, 1, spec.count).tolist() if spec.count > 1 else [0.0]
            out.append(Axis(names, spec.at(shares), spec.log))
        else:
            _check_values(keys.show(names), tuple(spec))
            out.append(Axis(names, tuple(spec), _geometric(spec)))
    return tuple(out)


def points(
    specs: Sequence[tuple[keys.Names, Range | Sequence[Any]]], sample: str, count: int, seed: int
) -> tuple[Axis, ...]:
    """The axes of a design of `count` points (scipy.stats.qmc).

    Args:
        specs: keys with a range each, or with a list, from which the points choose.
        sample: `sobol` (a power of two keeps its balance) or `latin`.
        count: of points.
        seed: of the design's scrambling.

    Raises:
        StudyError: the sample is unknown, or there is no point.
    """
    _check_once(specs)
    if sample not in ("sobol", "latin"):
        raise StudyError(f"sample is {sample!r}; use sobol or latin")
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise StudyError(f"points is {count!r}; use a whole number of at least 1")
    _check_size(count)
    rng = np.random.default_rng(seed)
    if sample == "sobol":
        most = int(np.ceil(np.log2(count)))
        design = qmc.Sobol(len(specs), rng=rng).random_base2(most)[:count]
    else:
        design = qmc.LatinHypercube(len(specs), rng=rng).random(count)
    out = []
    for (names, spec), shares in zip(specs, design.T):
        if isinstance(spec, Range):
            out.append(Axis(names, spec.at(shares.tolist()), spec.log))
        else:
            chosen = (shares * len(spec)).astype(int).tolist()
            out.append(Axis(names, tuple(spec[i] for i in chosen)))
    return tuple(out)


def _range(key: str, form: str, numbers: Sequence[str]) -> Range:
    try:
        low, high = (float(x) for x in numbers[:2])
        count = int(numbers[2]) if len(numbers) > 2 else None
        if len(numbers) > 3:
            raise ValueError
    except ValueError:
        given = ":".join([form, *numbers])
        raise StudyError(f"'{key}': {given} is no range; use {form}:LOW:HIGH:COUNT") from None
    if not (np.isfinite([low, high]).all() and low < high):
        raise StudyError(f"'{key}': the range from {low:g} to {high:g} is empty; give LOW < HIGH")
    if form == "log" and low <= 0:
        raise StudyError(f"'{key}': a log range starts above 0, got {low:g}; use lin:{low:g}:...")
    if count is not None and count < 1:
        raise StudyError(f"'{key}': the range has {count} values; use a count of at least 1")
    return Range(low, high, form == "log", count)


def _values(spec: str) -> tuple[Any, ...]:
    """The values of a list: TOML in brackets, or elements between commas."""
    try:
        found = tomllib.loads(f"v = {spec}")["v"]
        return tuple(found) if isinstance(found, list) else (found,)
    except tomllib.TOMLDecodeError:
        return tuple(_value(part.strip()) for part in spec.split(","))


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        return text


def _check_values(key: str, values: tuple[Any, ...]) -> None:
    if not values or "" in values:
        raise StudyError(f"'{key}': a value is missing; use {FORMS}")
    for i, value in enumerate(values):
        if value in values[:i]:
            raise StudyError(f"'{key}': the value {value!r} is given twice; give each once")


def _check_size(count: int) -> None:
    if count > MOST:
        raise StudyError(f"the study has {count:,} variants; use at most {MOST:,}")


def _check_once(specs: Sequence[tuple[keys.Names, Any]]) -> None:
    names = [n for n, _ in specs]
    if not names:
        raise StudyError("no key is varied; name one, e.g. filter.process_noise_scale=0.1,1,10")
    for i, name in enumerate(names):
        if name in names[:i]:
            raise StudyError(f"'{keys.show(name)}' is varied twice; name each key once")


def _geometric(values: Sequence[Any]) -> bool:
    """Whether numbers span a factor of 20 or more, and are best shown on a log scale."""
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and v > 0 for v in values):
        return False
    return len(values) > 1 and max(values) >= 20 * min(values)
