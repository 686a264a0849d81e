"""What a suite of sensors must reach, and the channels of which it may consist."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

from estbench.errors import ScenarioError, did_you_mean
from estbench.scenario.schema import Scenario
from estbench.spaces.patterns import expand, is_number

FORM = "use COORDINATE=SIGMA,..., e.g. root.x=0.01,root.rz=0.02"


def parse(text: str) -> dict[str, float]:
    """`root.x=0.01,root.r?=0.02` as a table of patterns.

    Raises:
        ScenarioError: it has another form, or a σ is no number above 0.
    """
    out: dict[str, float] = {}
    if not text.strip():
        return out  # `required` says so
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not (name and equals and is_number(value)):
            raise ScenarioError(f"--require {text!r}: {part!r} is no requirement; {FORM}")
        out[name] = float(value)
    return out


def required(given: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Coordinate -> the largest σ that is allowed.

    Raises:
        ScenarioError: nothing is required, a pattern matches no coordinate, or a σ is not above 0.
    """
    if not given:
        raise ScenarioError(f"--require is empty; {FORM}")
    for name, sigma in given.items():
        if not 0 < sigma < float("inf"):
            raise ScenarioError(f"--require: {name} is {sigma:g}; a σ is a number above 0")
    values = expand(dict(given), names, "--require", float("inf"))
    return {name: float(v) for name, v in zip(names, values) if v < float("inf")}


def candidates(patterns: Sequence[str], channels: Sequence[str]) -> tuple[str, ...]:
    """The channels that any pattern matches, or all.

    Raises:
        ScenarioError: a pattern matches no channel.
    """
    if list(patterns) in ([], ["all"]):
        return tuple(channels)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in channels):
            raise ScenarioError(
                f"--channels: '{pattern}' matches no channel{did_you_mean(pattern, channels)}"
            )
    return tuple(n for n in channels if any(fnmatchcase(n, pattern) for pattern in patterns))


def costs(scenario: Scenario, channels: Sequence[str]) -> dict[str, float]:
    """Channel -> its cost; 1 where the scenario gives none."""
    given = {name: section.cost for name, section in scenario.channels.items()}
    return {n: 1.0 if (cost := given.get(n)) is None else cost for n in channels}


def with_channels(scenario: Scenario, channels: Sequence[str]) -> Scenario:
    """The scenario with these channels in use, and no others."""
    kept = {n: belief for n, belief in scenario.filter.channels.items() if n in channels}
    belief = scenario.filter.model_copy(update={"channels": kept})
    return scenario.model_copy(update={"sensors": list(channels), "filter": belief})
