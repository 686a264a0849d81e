"""The reference estimator: the one whose estimate a scenario's controller sees.

It belongs to the scenario, not to the estimators under test: it is chosen from the tables of the
scenario file, before `-e` and `--set estimators...` change them, and is written out in
`control.estimator`. Its model is the true one: `[filter]` and `[start]` are of the estimators under
test. So the truth of each run depends on none of them.
"""

from collections.abc import Mapping
from typing import Any

from estbench.errors import ScenarioError, did_you_mean
from estbench.estimators.names import BUILTIN, known
from estbench.scenario.schema import Scenario

EKFS = ("ekf", "sr_ekf", "iekf", "cd_ekf", "schmidt_ekf", "bias_ekf")
"""The extended Kalman filters among which the default is looked for."""
LABEL = "control.estimator"
"""The label of the reference estimator, in messages and for its random numbers."""

Tables = Mapping[str, Mapping[str, Any]]
"""Label -> settings of an estimator."""


def settled(scenario: Scenario, tables: Tables | None = None) -> Scenario:
    """The scenario with the table of its reference estimator in `control.estimator`.

    Args:
        scenario: any; it is returned as it is unless `control.observe` is `reference`.
        tables: the estimators of the scenario file; default those of the scenario.

    Raises:
        ScenarioError: `control.estimator` names no estimator, or its table has no type.
    """
    control = scenario.control
    if control.observe != "reference":
        return scenario
    given = control.estimator
    if isinstance(given, dict):
        if not isinstance(given.get("type"), str):
            raise ScenarioError(
                f"control.estimator is {given}; a table needs a type, e.g. {{type = 'ekf'}}"
            )
        return scenario
    found = _table(given, scenario.estimators if tables is None else tables)
    return scenario.model_copy(update={"control": control.model_copy(update={"estimator": found})})


def seen(scenario: Scenario) -> str:
    """Words for what the controller sees, e.g. `the estimate of the reference (ekf)`."""
    control = settled(scenario).control
    if isinstance(control.estimator, dict) and control.observe == "reference":
        name = str(control.estimator["type"]).rpartition(":")[2]
        return f"the estimate of the reference ({name})"
    return f"the {control.observe}"


def is_ekf(table: Mapping[str, Any]) -> bool:
    """Whether the table of an estimator, with its `type`, is of one of `EKFS`."""
    return BUILTIN.get(table["type"], table["type"]) in {BUILTIN[name] for name in EKFS}


def _table(name: str | None, tables: Tables) -> dict[str, Any]:
    """The table, with its `type`, of a label, of another estimator's name, or of the default."""
    typed = {label: {"type": label, **table} for label, table in tables.items()}
    if name is not None:
        if name not in typed and ":" not in name and name not in known():
            hint = did_you_mean(name, {**known(), **typed})
            raise ScenarioError(f"control.estimator: no estimator '{name}'{hint}")
        return typed.get(name, {"type": name})
    exact = (
        table
        for table in typed.values()
        if is_ekf(table)
        and table.get("delays", "exact") == "exact"
        and not {"start", "filter"} & table.keys()
    )
    return next(exact, {"type": "ekf"})
