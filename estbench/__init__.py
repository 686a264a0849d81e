"""estbench: a testbed for state estimators on simulated robots.

>>> import estbench
>>> results = estbench.run("pendulum", ["ekf"], runs=20, duration=1.0)
>>> str(results["ekf"].verdict)
'consistent'
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estbench.errors import EstbenchError
    from estbench.montecarlo.results import Results
    from estbench.montecarlo.run import run
    from estbench.scenario.load import load
    from estbench.store.zarr import open_results

__all__ = ["EstbenchError", "Results", "load", "open_results", "run"]
__version__ = "0.1.0"

_HOME = {
    "EstbenchError": "errors",
    "Results": "montecarlo.results",
    "load": "scenario.load",
    "open_results": "store.zarr",
    "run": "montecarlo.run",
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used.

    So the command line starts before MuJoCo is imported, and can say what is wrong with that.
    """
    if name not in _HOME:
        raise AttributeError(f"module 'estbench' has no attribute '{name}'")
    return getattr(import_module(f"estbench.{_HOME[name]}"), name)
