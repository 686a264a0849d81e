"""Messages for all mistakes that the validation of a scenario finds, each with its path."""

import re
from typing import Any, get_args

from pydantic import ValidationError

from estbench.errors import did_you_mean
from estbench.scenario.quantities import Section

_OTHER = {"string_type", "list_type", "float_type", "int_type", "dict_type"}
_BY_OBJECT = ("set", "draw")
"""Tables whose keys are `field.object`, with a dot."""
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
    # A wrong number also fails as a list, the other branch: the first error is reported, and of a
    # list or a table the error within it.
    relevant = [e["loc"] for e in found if not e["other"]]
    inner = [e["loc"] for e in found]
    kept: dict[tuple[Any, ...], Any] = {}
    for e in found:
        loc, depth = e["loc"], len(e["loc"])
        same = any(r[:depth] == loc for r in relevant)
        within = any(len(i) > depth and i[:depth] == loc for i in inner)
        if not e["other"] or not (same or within):
            kept.setdefault(loc, e)
    return list(kept.values())


def _explain(error: Any, root: type[Section]) -> str:
    """One mistake as `path: message (did you mean ...)`."""
    where = ".".join(str(part) for part in error["loc"]) or "scenario"
    message = error["msg"].removeprefix("Value error, ")
    if hint := _dotted(error):
        return hint
    if error["type"] == "extra_forbidden":
        section: Any = root
        for part in error["loc"][:-1]:
            section = _inside(section, part)
        known = getattr(section, "model_fields", {})
        elsewhere = _sections(root, where) if section is root else []
        hint = f" (did you mean {' or '.join(elsewhere)}?)" if elsewhere else ""
        return f"{where}: unknown key{hint or did_you_mean(str(error['loc'][-1]), known)}"
    given = error.get("input")
    shown = f", got {given!r}" if isinstance(given, str | int | float | bool) else ""
    return f"{where}: {message}{shown}"


def _sections(root: type[Section], key: str) -> list[str]:
    """`section.key` of every section of the root that has this key."""
    sections = {name: _inside(root, name) for name in root.model_fields}
    return [f"'{n}.{key}'" for n, s in sections.items() if key in getattr(s, "model_fields", {})]


def _dotted(error: Any) -> str:
    """Words for a key `field.object` that was written without quotes; else empty."""
    path, value = [str(part) for part in error["loc"]], error.get("input")
    at = next((i for i, part in enumerate(path[:2]) if part in _BY_OBJECT), None)
    if at is None or len(path) < at + 2:
        return ""
    if path[at] == "set":
        while isinstance(value, dict) and value:
            name, value = next(iter(value.items()))
            path.append(str(name))
    elif error["type"] != "extra_forbidden":
        return ""
    if len(path) < at + 3 or "." in path[at + 1]:  # it has its quotes
        return ""
    from estbench.robots import parameters  # with MuJoCo, for this mistake only

    field, key, table = path[at + 1], ".".join(path[at + 1 :]), ".".join(path[: at + 1])
    wrong = parameters.unknown_field(field)
    return f'{table}: {wrong + "; " if wrong else ""}quote a key with a dot: {path[at]}."{key}"'


def _inside(section: Any, key: Any) -> Any:
    """The section class found under `key` of a section or of a table of sections."""
    fields = getattr(section, "model_fields", None)
    annotation = fields[key].annotation if fields and key in fields else section
    options = [annotation, *get_args(annotation)]
    options += [arg for option in options for arg in get_args(option)]
    found = [o for o in options if isinstance(o, type) and issubclass(o, Section)]
    return found[0] if found else annotation
