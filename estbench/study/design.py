"""A study: a scenario, the varied keys, its variants, and which of them share one truth."""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estbench.errors import StudyError
from estbench.scenario.filter import FilterSection
from estbench.scenario.schema import ConsistencySection, Scenario, StartSection, TaskSection
from estbench.study import keys
from estbench.study.axes import Axis

POINT = "point"
"""The dimension of a design whose keys vary together."""


@dataclass(frozen=True, eq=False)
class Study:
    """Variants of one scenario.

    Attributes:
        scenario: as resolved; its estimators run in every variant.
        axes: the varied keys; a variant leaves a key whose value is None as it is.
        grid: whether every value meets every other; else the keys vary together, one variant per
            point.
    """

    scenario: Scenario
    axes: tuple[Axis, ...]
    grid: bool = True

    @property
    def dims(self) -> tuple[str, ...]:
        """The dimensions of its variants."""
        return tuple(axis.key for axis in self.axes) if self.grid else (POINT,)

    @property
    def shape(self) -> tuple[int, ...]:
        """Their lengths."""
        lengths = tuple(len(axis.values) for axis in self.axes)
        return lengths if self.grid else lengths[:1]

    @property
    def labels(self) -> tuple[str, ...]:
        """The estimators."""
        return tuple(self.scenario.estimators)

    @cached_property
    def variants(self) -> tuple[Scenario, ...]:
        """The scenarios in the order of the dimensions, the last one fastest.

        Raises:
            StudyError: a key does not exist, or a value does not fit it.
        """
        for axis in self.axes:
            _check_free(self, axis)
        values = (axis.values for axis in self.axes)
        rows = itertools.product(*values) if self.grid else zip(*values)
        return tuple(keys.changed(self.scenario, self._changes(row)) for row in rows)

    def _changes(self, row: Iterable[Any]) -> dict[keys.Names, Any]:
        """Key -> value of one variant, without the keys that it leaves as they are."""
        return {axis.names: v for axis, v in zip(self.axes, row) if v is not None}

    @cached_property
    def groups(self) -> tuple[NDArray[np.int64], ...]:
        """Indices of the variants that share truth and readings, with the block that they fill.

        Each is an array with an axis per dimension, so that a group is a block of the store.
        """
        index = np.arange(len(self.variants)).reshape(self.shape)
        _, number = np.unique([truth_key(s) for s in self.variants], return_inverse=True)
        truth = number.reshape(self.shape)
        own = [bool((truth != truth.take([0], axis)).any()) for axis in range(truth.ndim)]
        blocks = itertools.product(
            *([slice(i, i + 1) for i in range(n)] if alone else [slice(None)]
              for n, alone in zip(self.shape, own))
        )  # fmt: skip
        return tuple(index[block] for block in blocks)


def truth_key(scenario: Scenario) -> str:
    """Equal for scenarios with equal truth and readings.

    These depend neither on the estimators nor on what the filters believe, except that a sensor
    without noise may stay so if the filter is told its own R (`sensors.channel.build`).
    """
    told = sorted(
        name for name, c in scenario.filter.channels.items() if (c.noise, c.cov) != (None, None)
    )
    shared: Mapping[str, Any] = {
        "filter": FilterSection(), "start": StartSection(), "consistency": ConsistencySection(),
        "estimators": {"ekf": {}}, "task": TaskSection(), "description": "",
    }  # fmt: skip
    return scenario.model_copy(update=dict(shared)).to_toml() + "\n".join(told)


def _check_free(study: Study, axis: Axis) -> None:
    """Refuse keys that would give variants which cannot be compared."""
    section, *rest = axis.names
    if (section, *rest[:1]) in (("simulation", "runs"), ("simulation", "seed")):
        raise StudyError(
            f"'{axis.key}' is not free to vary: all variants have the same runs; use --{rest[0]}"
        )
    if section == "estimators" and rest and rest[0] not in study.labels:
        raise StudyError(
            f"'{axis.key}' has no effect: '{rest[0]}' is not run; the estimators that run are "
            f"{', '.join(study.labels)}"
        )
