"""What an estimator's own table overrides of the scenario's `[filter]`."""

from typing import Any

from pydantic import ValidationError

from estbench.errors import EstimatorError, ScenarioError
from estbench.scenario.filter import FilterSection
from estbench.scenario.mistakes import explain
from estbench.scenario.schema import Scenario

LOOP = ("delays", "filter", "start")
"""Keys of an estimator's table that are not settings of its class."""


def believed(scenario: Scenario, label: str) -> FilterSection:
    """`[filter]` as it holds for one estimator: overridden key by key by the table `filter` of it.

    `delays` in the table of the estimator is `filter.delays`.

    Raises:
        ScenarioError: the estimator's `filter` is not a table, or does not validate.
        EstimatorError: its `delays` is unknown.
    """
    table = scenario.estimators[label]
    own = table.get("filter", {})
    if not isinstance(own, dict):
        raise ScenarioError(
            f"estimators.{label}.filter is {own!r}; use a table, e.g. "
            "filter = {process_noise_scale = 2.0}"
        )
    if "delays" in table:
        if table["delays"] not in ("exact", "naive"):
            raise EstimatorError(f"{label}: delays is {table['delays']!r}; use 'exact' or 'naive'")
        own = {"delays": table["delays"]} | own
    if not own:
        return scenario.filter
    try:
        return FilterSection.model_validate(
            merged(scenario.filter.model_dump(exclude_unset=True), own)
        )
    except ValidationError as error:
        found = explain(error, FilterSection)
        raise ScenarioError(
            "; ".join(f"estimators.{label}.filter.{mistake}" for mistake in found)
        ) from None


def merged(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A nested table with the values of another: key by key where both hold tables."""
    out = dict(table)
    for key, value in changes.items():
        old = out.get(key)
        if isinstance(old, dict) and isinstance(value, dict):
            value = merged(old, value)
        out[key] = value
    return out
