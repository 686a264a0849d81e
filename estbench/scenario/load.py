"""Reading a scenario: a bundled name, a TOML file, a results folder or an MJCF file."""

import copy
import tomllib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from estbench.errors import EstimatorError, ScenarioError, did_you_mean, shown
from estbench.estimators.names import known, name_of
from estbench.scenario import code, files, reference
from estbench.scenario.mistakes import explain
from estbench.scenario.schema import Scenario, SimulationSection, StartSection

__all__ = ["Scenario", "changes", "load", "override", "parse", "resolve", "start"]


def load(source: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario: a bundled name, a TOML file, a results folder, or an MJCF file.

    Args:
        source: name or path.
        overrides: `section.key=value` strings, values in TOML syntax (bare words are strings).

    Raises:
        ScenarioError: there is no such scenario, or it does not validate, of which all mistakes
            are listed; or it is of somebody else and names code (see `scenario.code`).
    """
    _check_overrides(overrides)
    path = files.find(source)
    if path.suffix.lower() == ".xml":
        data: dict[str, Any] = {"name": path.stem, "model": {"path": path.name}}
    else:
        data = _read_toml(path)
    _resolve_paths(data, path.parent)
    own = dict(code.named(data))
    scenario = _validate(data, overrides, str(source))
    kept = {k: v for k, v in code.named(scenario.model_dump(exclude_none=True)) if own.get(k) == v}
    code.check(kept, path)
    return scenario


def parse(toml: str) -> Scenario:
    """The scenario of a resolved TOML text, as `Scenario.to_toml` writes it."""
    return Scenario.model_validate(tomllib.loads(toml))


def override(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """The scenario with `section.key=value` strings applied.

    Raises:
        ScenarioError: the result does not validate.
    """
    if not overrides:
        return reference.settled(scenario)
    return _validate(scenario.dumped(), overrides, scenario.name)


Chosen = str | type | Sequence[str | type]
"""Estimators to run: a label, a name or a class, or several of them."""


def resolve(
    scenario: str | Path | Scenario,
    estimators: Chosen | None = None,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
) -> Scenario:
    """The scenario of `experiment.run`'s arguments.

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimators: labels, names or classes that replace the scenario's; the label of a class is
            its name, and the scenario's table of that label holds its settings.
        runs: count of Monte Carlo runs; default the scenario's.
        seed: default the scenario's.
        duration: length of each run, s; default the scenario's.
        overrides: `section.key=value` strings.

    Raises:
        ScenarioError: there is no such scenario, it does not validate, or an override names an
            estimator that is not run.
        EstimatorError: an estimator is unknown or named twice, or its label is taken.
    """
    _check_overrides(overrides)
    if not isinstance(scenario, str | Path | Scenario):
        raise ScenarioError(f"scenario is {scenario!r}; use a name, a path or a Scenario")
    simulation = {"runs": runs, "seed": seed, "duration": duration}
    options = [f"simulation.{k}={v}" for k, v in simulation.items() if v is not None]
    _check_options(options)
    overrides = [*options, *overrides]
    if isinstance(scenario, Scenario):
        resolved = override(scenario, overrides)
    else:
        resolved = load(scenario, overrides)
    if not (estimators is None or isinstance(estimators, str | type | Sequence)):
        raise EstimatorError(
            f"estimators is {estimators!r}; use a label, a name, a class, or a list of them"
        )
    if estimators:
        chosen = _chosen(estimators, resolved.estimators)
        resolved = resolved.model_copy(update={"estimators": chosen})
    for text in overrides:
        section, *label = _parsed(text)[0][:2]
        if section == "estimators" and label and label[0] not in resolved.estimators:
            raise ScenarioError(
                f"--set {text!r} has no effect: '{label[0]}' is not run; the estimators that run "
                f"are {', '.join(resolved.estimators)}"
            )
    if "truth" in resolved.estimators:
        raise ScenarioError("estimators.truth: the label 'truth' is taken; choose another")
    return resolved


def _check_options(options: Sequence[str]) -> None:
    """Refuse an invalid --runs, --seed or --duration with a message that names the option."""
    given: dict[str, Any] = {}
    for text in options:
        _apply(given, text)
    try:
        SimulationSection.model_validate(given.get("simulation", {}))
    except ValidationError as error:
        raise ScenarioError(
            "; ".join(f"--{mistake}" for mistake in explain(error, SimulationSection))
        ) from None


def _chosen(estimators: Chosen, tables: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Label -> settings of the estimators to run, from the scenario's tables where they exist."""
    several = [estimators] if isinstance(estimators, str | type) else estimators
    chosen: dict[str, dict[str, Any]] = {}
    for name in map(name_of, several):
        if name not in tables and ":" not in name and name not in known():
            hint = did_you_mean(name, {**known(), **tables})
            hint = "; name each by itself (-e ekf -e ukf)" if "," in name else hint
            raise EstimatorError(f"no estimator '{name}'{hint}")
        label = name.rpartition(":")[2]
        if not label:
            raise EstimatorError(
                f"estimator '{name}': the name after the colon is missing; use package.module:Name"
            )
        if label in chosen:
            raise EstimatorError(f"estimator '{label}' is named twice; give each its own label")
        own = tables.get(label, {})
        if label != name and own.get("type", name) != name:
            raise EstimatorError(
                f"estimator '{name}': the label '{label}' is that of the scenario's "
                f"{own['type']!r}; choose that label, or give one of them another name"
            )
        chosen[label] = own if label == name else {**own, "type": name}
    return chosen


def start(scenario: Scenario, label: str) -> StartSection:
    """How an estimator starts: the scenario's `[start]`, overridden by the estimator's table.

    Raises:
        ScenarioError: the estimator's `start` is not a table, or does not validate.
    """
    own = scenario.estimators[label].get("start", {})
    if not isinstance(own, dict):
        raise ScenarioError(
            f"estimators.{label}.start is {own!r}; use a table, e.g. start = {{inflate = 10.0}}"
        )
    try:
        return StartSection.model_validate(scenario.start.model_dump() | own)
    except ValidationError as error:
        found = explain(error, StartSection)
        raise ScenarioError(
            "; ".join(f"estimators.{label}.start.{mistake}" for mistake in found)
        ) from None


def changes(before: Any, now: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    """Differences of two nested tables: dotted key, value before and value now (None if absent)."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return [] if before == now else [(key, before, now)]
    return [
        change
        for k in sorted({*before, *now})
        for change in changes(before.get(k), now.get(k), f"{key}.{k}".lstrip("."))
    ]


def _validate(data: dict[str, Any], overrides: Sequence[str], source: str) -> Scenario:
    """Apply the overrides, whose paths are relative to the current folder, and validate.

    The reference estimator of the controller is chosen among the estimators before the overrides.
    """
    default = Scenario.model_fields["estimators"].get_default(call_default_factory=True)
    given = copy.deepcopy(data.get("estimators", default))
    before = (
        {k: v for k, v in given.items() if isinstance(v, dict)} if isinstance(given, dict) else {}
    )
    for text in overrides:
        _apply(data, text)
    _resolve_paths(data, Path.cwd())
    try:
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(f"{source}: " + "; ".join(explain(error, Scenario))) from None
    return reference.settled(scenario, {**before, **scenario.estimators, **before})


def _check_overrides(overrides: object) -> None:
    if (
        isinstance(overrides, str)
        or not isinstance(overrides, Sequence)
        or not all(isinstance(text, str) for text in overrides)
    ):
        raise ScenarioError(f"overrides is {shown(overrides)}; use a list of 'section.key=value'")


def _read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        ScenarioError: the file is not valid TOML or cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name} is not valid TOML: {error}") from None
    except OSError as error:
        raise ScenarioError(f"{path} cannot be read: {error.strerror}") from None


def _apply(data: dict[str, Any], override: str) -> None:
    """Set one `a.b.c=value` in nested tables."""
    (*sections, last), value = _parsed(override)
    table = data
    for part in sections:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {override!r}: '{part}' is a value, not a section")
    table[last] = value


def _parsed(override: str) -> tuple[list[str], Any]:
    """Keys and value of `a.b.c=value`; a quoted key may contain dots and globs."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ScenarioError(f"--set {override!r} is not of the form section.key=value")
    if "\n" in override or "\r" in override:
        raise ScenarioError(f"--set {override!r} has a line break; use one --set for each key")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    try:
        parts = tomllib.loads(f"{key} = 0")
        if not parts:  # a comment
            raise tomllib.TOMLDecodeError
    except tomllib.TOMLDecodeError:
        raise ScenarioError(f"--set {override!r}: '{key}' is not a dotted TOML key") from None
    names: list[str] = []
    while isinstance(parts, dict):
        ((part, parts),) = parts.items()
        names.append(part)
    return names, value


def _resolve_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of files absolute, so that a stored scenario still finds them."""
    for section in ("model", "filter", "control"):
        table = data.get(section)
        if isinstance(table, dict) and isinstance(path := table.get("path"), str):
            is_file = ":" not in path.split("/")[0]
            table["path"] = _portable(folder / path) if is_file else path


def _portable(path: Path) -> str:
    """`estbench:assets/...` for a file that ships with estbench, else the absolute path."""
    root = Path(str(resources.files("estbench") / "assets")).resolve()
    resolved = path.resolve()
    if resolved.is_relative_to(root):
        return f"estbench:assets/{resolved.relative_to(root).as_posix()}"
    return str(resolved)
