"""Objects that a user names as `module:name`: a class of estimators, a function of a scenario."""

import importlib
import importlib.machinery
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estbench.errors import EstimatorError, ScenarioError, did_you_mean, user_error_location


def location(module: str) -> Path | None:
    """The file of a module's package, found without running any of it; None where there is none."""
    top = module.partition(".")[0]
    found = importlib.machinery.PathFinder.find_spec(top, [*sys.path, str(Path.cwd())])
    if found is None:
        return None
    places = [found.origin] if found.origin else list(found.submodule_search_locations or ())
    return Path(places[0]).resolve() if places else None


def is_own(file: Path) -> bool:
    """Whether a file is under the current directory or in an installed package.

    The folders of `PYTHONPATH` are no installed packages, and neither is Python's library.
    """
    here = Path(__file__).parent
    sites = [Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]
    linked = [Path(line) for site in sites for line in _links(site)]
    own = [Path.cwd(), here, here / "assets", *sites, *linked]
    path = file.resolve()
    return any(path.is_relative_to(folder.resolve()) for folder in own)


def _links(site: Path) -> list[str]:
    """The folders of the packages that are installed in place (`pip install --editable`)."""
    files = site.glob("*.pth")
    lines = [line for f in files for line in f.read_text(errors="replace").splitlines()]
    return [line for line in lines if line.startswith("/") and Path(line).is_dir()]


def load_module(module: str, what: str) -> Any:
    """Import a user's module from the current folder or the import path.

    Raises:
        EstimatorError: it cannot be imported.
    """
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    if module.endswith(".py") and Path(module).is_file():
        raise EstimatorError(
            f"{what}: '{module}' is a file; name its module, {_importable(module)}"
        )
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise EstimatorError(
            f"{what}: cannot import '{module}': {user_error_location(error)}"
        ) from None


def _importable(file: str) -> str:
    """How the module of a file is named: below the current folder, or on the import path."""
    path = Path(file).resolve()
    if path.is_relative_to(Path.cwd().resolve()):
        name = ".".join(path.relative_to(Path.cwd().resolve()).with_suffix("").parts)
        return f"'{name}'"
    return f"'{path.stem}', with its folder in PYTHONPATH: '{path.parent}'"


def function(target: str, where: str) -> Callable[..., Any]:
    """The function `module:name`, from the current folder or the import path.

    Raises:
        ScenarioError: there is no such function.
    """
    module, colon, name = target.partition(":")
    if not (colon and module and name):
        raise ScenarioError(f"{where} is {target!r}; use 'module:function'")
    try:
        loaded = load_module(module, where)
    except EstimatorError as error:
        raise ScenarioError(str(error)) from None
    found = getattr(loaded, name, None)
    if not callable(found):
        public = [n for n, v in vars(loaded).items() if callable(v) and not n.startswith("_")]
        raise ScenarioError(
            f"{where}: module {module} has no function '{name}'{did_you_mean(name, public)}"
        )
    return found
