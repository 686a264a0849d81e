"""The error budget of one estimator: what each source contributes, as numbers and as a Dataset."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from estbench.budgets.linear import Linear
from estbench.budgets.montecarlo import Sampled
from estbench.budgets.sources import CONDITIONS, Source, grouped
from estbench.shapes import Array, Float

TOGETHER = Source("model.together", "model", "model")
"""What wrong parameters, offsets and delays add because they are there at the same time."""


@dataclass(frozen=True, eq=False)
class Budget:
    """An error budget; variances are mean square errors, (unit)².

    Attributes:
        scenario: its name.
        estimator: the label.
        names, units: of the coordinates.
        times: s.
        burn_in: s that the averages over time leave out.
        linear: by linear covariance analysis; None where the estimator has none.
        sampled: by Monte Carlo; None where it was not asked for.
        by_source: whether each coordinate of the initial error and each component of the process
            noise is a source; else these are one source each.
        notices: what is left out, and why.
    """

    scenario: str
    estimator: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    times: Float[Array, " time"]
    burn_in: float
    linear: Linear | None
    sampled: Sampled | None
    by_source: bool = False
    notices: tuple[str, ...] = ()

    @cached_property
    def sources(self) -> tuple[Source, ...]:
        """Those with a contribution of their own."""
        if self.sampled is not None:
            found = [s for s in self.sampled.sources if s.kind not in CONDITIONS]
            known = {s.name for s in found}
            extra = [] if self.linear is None else self.linear.sources
            found += [s for s in extra if s.kind == "model" and s.name not in known]
        else:
            assert self.linear is not None  # one of the two is there
            found = list(self.linear.sources if self.by_source else grouped(self.linear.sources))
        if self.linear is not None and self.linear.together.any():
            found.append(TOGETHER)
        return tuple(found)

    def over_time(self, source: Source) -> Float[Array, "time n"]:
        """The linear mean square error by one source; NaN where there is none."""
        linear = self.linear
        if linear is not None and source is TOGETHER:
            return linear.together
        parts = [] if linear is None else [
            linear.variance[:, i]
            for i, s in enumerate(linear.sources)
            if s.name == source.name or (not source.target and s.group == source.name)
        ]  # fmt: skip
        none = np.full((len(self.times), len(self.names)), np.nan)
        return np.sum(parts, axis=0) if parts else none

    def sampled_over_time(self, source: Source | None) -> Float[Array, "time n"]:
        """The same by Monte Carlo, of all sources for None; NaN where there is none."""
        key = ("all", "") if source is None else ("alone", source.name)
        none = np.full((len(self.times), len(self.names)), np.nan)
        return none if self.sampled is None else self.sampled.over_time.get(key, none)

    @property
    def settled(self) -> Any:
        """The times over which the averages are."""
        return (self.times > self.burn_in) & (self.times > 0)

    def average(self, values: Float[Array, "time n"]) -> Float[Array, " n"]:
        """The mean over time."""
        return values[self.settled].mean(axis=0)

    def contribution(self, source: Source) -> Float[Array, " n"]:
        """The mean square error by one source: linear, or that of the Monte Carlo without it."""
        found = self.average(self.over_time(source))
        if np.isnan(found).all() and self.sampled is not None and source is not TOGETHER:
            return np.array([i.value for i in self.sampled.alone(source)])
        return found

    @property
    def total(self) -> Float[Array, " n"]:
        """The mean square error of all sources together."""
        if self.linear is not None:
            return self.average(self.linear.total)
        assert self.sampled is not None
        return np.array([i.value for i in self.sampled.total()])

    @property
    def share(self) -> Float[Array, "source n"]:
        """The part of the sum of all contributions that each source has."""
        parts = np.stack([self.contribution(source) for source in self.sources])
        total = parts.sum(axis=0) if self.linear is None else self.total
        return parts / np.where(total > 0, total, 1.0)

    def dataset(self) -> xr.Dataset:
        """The budget with the dimensions `source`, `coordinate` and `time`.

        `variance`, `share` and `std` are averages over time; `variance_over_time`, `believed` and
        `total` are linear; `alone`, `without` and `rest`, with `_low` and `_high`, are those of the
        Monte Carlo, as are `alone_over_time` and `sampled_over_time`.
        """
        found: dict[str, Any] = {
            "variance": (("source", "coordinate"), [self.contribution(s) for s in self.sources]),
            "share": (("source", "coordinate"), self.share),
        }
        found["std"] = (("source", "coordinate"), np.sqrt(np.maximum(found["variance"][1], 0.0)))
        if self.linear is not None:
            stacked = np.stack([self.over_time(s) for s in self.sources])
            found["variance_over_time"] = (("source", "time", "coordinate"), stacked)
            found["total"] = (("time", "coordinate"), self.linear.total)
            found["believed"] = (("time", "coordinate"), self.linear.believed)
        coords: dict[str, Any] = {
            "source": [s.name for s in self.sources],
            "group": ("source", [s.group for s in self.sources]),
            "coordinate": list(self.names),
            "unit": ("coordinate", list(self.units)),
            "time": self.times,
        }
        if self.sampled is not None:
            found |= self._of_sampled()
            coords["removed"] = [s.name for s in self.sampled.sources]
        attrs = {"scenario": self.scenario, "estimator": self.estimator,
                 "notices": list(self.notices)}  # fmt: skip
        return xr.Dataset(found, coords, attrs)

    def _of_sampled(self) -> dict[str, Any]:
        assert self.sampled is not None
        sampled, none = self.sampled, np.full((len(self.names), 3), np.nan)
        known = {name for what, name in sampled.mse if what == "alone"}
        tables = {
            "alone": ("source", [_ends(sampled.alone(s)) if s.name in known else none
                                 for s in self.sources]),
            "without": ("removed", [_ends(sampled.removed(s)) for s in sampled.sources]),
        }  # fmt: skip
        out: dict[str, Any] = {
            "alone_over_time": (("source", "time", "coordinate"),
                                [self.sampled_over_time(s) for s in self.sources]),
            "sampled_over_time": (("time", "coordinate"), self.sampled_over_time(None)),
        }  # fmt: skip
        for i, suffix in enumerate(("", "_low", "_high")):
            for name, (dim, values) in tables.items():
                out[name + suffix] = ((dim, "coordinate"), np.array(values)[..., i])
            for name, ends in (("rest", sampled.rest()), ("sampled_total", sampled.total())):
                out[name + suffix] = ("coordinate", _ends(ends)[:, i])
        return out


def _ends(intervals: Any) -> Array:
    return np.array([[i.value, i.low, i.high] for i in intervals])
