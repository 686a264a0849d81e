"""Messages for all mistakes that the validation of a scenario finds, each with its path."""

import re
from typing import Any, get_args

from pydantic import ValidationError

from estbench.errors import did_you_mean
from estbench.scenario.schema import Section

_OTHER = {"string_type", "list_type", "float_type", "int_type", "dict_type"}
_BRANCH = re.compile(r"(float|str|int|list|dict|tuple|function-after|constrained-\w+)\b(\[.*)?")


def explain(error: ValidationError, root: type[Section]) -> list[str]:
    """The mistakes in a section of class `root`, each as `path: message`."""
    return [_explain(e, root) for e in _relevant(error)]


def _relevant(error: ValidationError) -> list[Any]:
    """The errors of a validation, without union branch names and errors of other branches."""
    found = []
    for e in error.errors():
        own = tuple(p for p in e["loc"] if isinstance(p, int) or not _BRANCH.fullmatch(p))
        found.append({**e, "loc": own, "other": e["type"] in _OTHER})
    # A wrong number also fails as a list, the other branch: only the first error is reported.
    relevant = [e["loc"] for e in found if not e["other"]]
    kept: dict[tuple[Any, ...], Any] = {}
    for e in found:
        if not e["other"] or not any(loc[: len(e["loc"])] == e["loc"] for loc in relevant):
            kept.setdefault(e["loc"], e)
    return list(kept.values())


def _explain(error: Any, root: type[Section]) -> str:
    """One mistake as `path: message (did you mean ...)`."""
    where = ".".join(str(part) for part in error["loc"]) or "scenario"
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        section: Any = root
        for part in error["loc"][:-1]:
            section = _inside(section, part)
        known = getattr(section, "model_fields", {})
        return f"{where}: unknown key{did_you_mean(str(error['loc'][-1]), known)}"
    given = error.get("input")
    shown = f", got {given!r}" if isinstance(given, str | int | float | bool) else ""
    return f"{where}: {message}{shown}"


def _inside(section: Any, key: Any) -> Any:
    """The section class found under `key` of a section or of a table of sections."""
    fields = getattr(section, "model_fields", None)
    annotation = fields[key].annotation if fields and key in fields else section
    options = [annotation, *get_args(annotation)]
    options += [arg for option in options for arg in get_args(option)]
    found = [o for o in options if isinstance(o, type) and issubclass(o, Section)]
    return found[0] if found else annotation
