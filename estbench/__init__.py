"""estbench: a testbed for state estimators on simulated robots.

>>> import estbench
>>> results = estbench.run("pendulum", ["ekf"], runs=20, duration=1.0)
>>> str(results["ekf"].verdict)
'consistent'
"""

from estbench.errors import EstbenchError
from estbench.experiment import run
from estbench.results import Results
from estbench.scenario import load
from estbench.store import open_results

__all__ = ["EstbenchError", "Results", "load", "open_results", "run"]
__version__ = "0.1.0"
