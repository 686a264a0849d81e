"""Reading a scenario: a bundled name, a TOML file, a results folder or a bare MJCF."""

import tomllib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from estbench.errors import EstimatorError, ScenarioError, did_you_mean
from estbench.estimators import registry
from estbench.mistakes import explain
from estbench.sections import Scenario, StartSection

__all__ = ["Scenario", "bundled", "changes", "load", "override", "parse", "resolve", "start"]


def bundled() -> dict[str, Path]:
    """The scenarios that ship with estbench: name -> path of its TOML file.

    `assets/NAME/scenario.toml` is NAME; another `assets/NAME/OTHER.toml` is OTHER.
    """
    root = Path(str(resources.files("estbench") / "assets"))
    found = {}
    for path in sorted(root.glob("*/*.toml")):
        found[path.parent.name if path.stem == "scenario" else path.stem] = path
    return found


def load(source: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario: a bundled name, a TOML file, a results folder, or a bare MJCF.

    Args:
        source: name or path.
        overrides: `section.key=value` strings, values in TOML syntax (bare words are strings).

    Raises:
        ScenarioError: there is no such scenario, or it does not validate; every mistake is named.
    """
    path = _find(source)
    if path.suffix.lower() == ".xml":
        data: dict[str, Any] = {"name": path.stem, "model": {"path": path.name}}
    else:
        data = _read_toml(path)
    _resolve_paths(data, path.parent)
    return _validate(data, overrides, str(source))


def parse(toml: str) -> Scenario:
    """The scenario of a resolved TOML text, as `Scenario.to_toml` writes it."""
    return Scenario.model_validate(tomllib.loads(toml))


def override(scenario: Scenario, overrides: Sequence[str]) -> Scenario:
    """The scenario with `section.key=value` strings applied.

    Raises:
        ScenarioError: the result does not validate.
    """
    if not overrides:
        return scenario
    return _validate(scenario.model_dump(exclude_none=True), overrides, scenario.name)


def resolve(
    scenario: str | Path | Scenario,
    estimators: Sequence[str] | None = None,
    runs: int | None = None,
    seed: int | None = None,
    duration: float | None = None,
    overrides: Sequence[str] = (),
) -> Scenario:
    """The scenario of `experiment.run`'s arguments.

    Args:
        scenario: a bundled name, a TOML or MJCF path, a results folder, or a `Scenario`.
        estimators: labels or names to run in place of the scenario's.
        runs: Monte Carlo runs, in place of the scenario's.
        seed: in place of the scenario's.
        duration: s, in place of the scenario's.
        overrides: `section.key=value` strings.

    Raises:
        ScenarioError: there is no such scenario, or it does not validate.
        EstimatorError: an estimator is not known, or named twice.
    """
    simulation = {"runs": runs, "seed": seed, "duration": duration}
    overrides = [f"simulation.{k}={v}" for k, v in simulation.items() if v is not None] + [
        *overrides
    ]
    if isinstance(scenario, Scenario):
        resolved = override(scenario, overrides)
    else:
        resolved = load(scenario, overrides)
    if estimators:
        known = dict(resolved.estimators)
        chosen = {}
        for name in estimators:
            label = name.rpartition(":")[2] if ":" in name else name
            if label in chosen:
                raise EstimatorError(f"estimator '{label}' is named twice; give each its own label")
            chosen[label] = known.get(name, {} if label == name else {"type": name})
            if name not in known and ":" not in name and name not in registry.known():
                hint = did_you_mean(name, {**registry.known(), **known})
                raise EstimatorError(f"no estimator '{name}'{hint}")
        resolved = resolved.model_copy(update={"estimators": chosen})
    if "truth" in resolved.estimators:
        raise ScenarioError("estimators.truth: the label 'truth' is taken; choose another")
    return resolved


def start(scenario: Scenario, label: str) -> StartSection:
    """How the estimator of a label starts: the scenario's [start], changed by its own table.

    Raises:
        ScenarioError: its `start` is not a table, or does not validate.
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
    """Where two nested tables differ: dotted key, and the value before and now (None without)."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return [] if before == now else [(key, before, now)]
    return [
        change
        for k in sorted({*before, *now})
        for change in changes(before.get(k), now.get(k), f"{key}.{k}".lstrip("."))
    ]


def _validate(data: dict[str, Any], overrides: Sequence[str], source: str) -> Scenario:
    """Apply the overrides (their paths are relative to the current folder) and validate."""
    for text in overrides:
        _apply(data, text)
    _resolve_paths(data, Path.cwd())
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(f"{source}: " + "; ".join(explain(error, Scenario))) from None


def _find(source: str | Path) -> Path:
    path = Path(source)
    if path.is_dir() and (path / "scenario.toml").is_file():
        return path / "scenario.toml"
    if path.is_file() and path.suffix.lower() in (".toml", ".xml"):
        return path.resolve()
    if path.is_file():
        raise ScenarioError(f"{source} is neither .toml nor .xml; name a scenario or an MJCF file")
    known = bundled()
    if str(source) in known:
        return known[str(source)]
    kind = "file" if path.suffix in (".toml", ".xml") else "scenario"
    raise ScenarioError(f"no {kind} '{source}'{did_you_mean(str(source), known)}")


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path.name} is not valid TOML: {error}") from None
    except OSError as error:
        raise ScenarioError(f"{path} cannot be read: {error.strerror}") from None


def _apply(data: dict[str, Any], override: str) -> None:
    """Set one `a.b.c=value` in nested tables; a quoted part may hold dots or globs."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ScenarioError(f"--set {override!r} is not of the form section.key=value")
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
    table = data
    while True:
        (part, rest), *_ = parts.items()
        if not isinstance(rest, dict):
            table[part] = value
            return
        table, parts = table.setdefault(part, {}), rest
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {override!r}: '{part}' is a value, not a section")


def _resolve_paths(data: dict[str, Any], folder: Path) -> None:
    """Make relative files absolute, so that the saved scenario still finds them."""
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
