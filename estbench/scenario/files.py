"""The files of scenarios: those that ship with estbench, and the one that a user names.

Their content is not looked at: `estbench list` and the message for a mistyped name need no more.
"""

from importlib import resources
from pathlib import Path

from estbench.errors import ScenarioError, did_you_mean, given_path


def bundled() -> dict[str, Path]:
    """The scenarios that ship with estbench: name -> path of its TOML file.

    `assets/NAME/scenario.toml` is NAME; another `assets/NAME/OTHER.toml` is OTHER.
    """
    root = Path(str(resources.files("estbench") / "assets"))
    found = {}
    for path in sorted(root.glob("*/*.toml")):
        found[path.parent.name if path.stem == "scenario" else path.stem] = path
    return found


def find(source: str | Path) -> Path:
    """The TOML or MJCF file of a scenario.

    Raises:
        ScenarioError: there is none.
    """
    path = given_path("scenario", source, ScenarioError)
    if path.is_dir() and (path / "scenario.toml").is_file():
        return path / "scenario.toml"
    if path.is_file() and path.suffix.lower() in (".toml", ".xml"):
        return path.resolve()
    if path.is_file():
        raise ScenarioError(f"{source} is neither .toml nor .xml; name a scenario or an MJCF file")
    known = bundled()
    if str(source) in known:
        return known[str(source)]
    near = [
        f"'{path}{suffix}'" for suffix in (".toml", ".xml") if Path(f"{path}{suffix}").is_file()
    ]
    if near:
        raise ScenarioError(f"no scenario '{source}' (did you mean {' or '.join(near)}?)")
    kind = "file" if path.suffix in (".toml", ".xml") else "scenario"
    raise ScenarioError(f"no {kind} '{source}'{did_you_mean(str(source), known)}")
