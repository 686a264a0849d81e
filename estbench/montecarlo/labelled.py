"""The results of an experiment as labelled arrays and as a table of runs."""

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from estbench.consistency.fields import PHASES, RUN
from estbench.consistency.records import COST, SUMMARY
from estbench.store.template import provenance

if TYPE_CHECKING:
    import pandas as pd

    from estbench.montecarlo.results import Results

_FIELDS = SUMMARY | COST


def to_xarray(results: "Results") -> xr.DataTree:
    """What was kept of each run, as `estbench.open_results` has it without the traces.

    One group for each estimator; dimensions run, time, coordinate, ...; the attribute `meaning` of
    each variable has its unit.
    """
    labels = {
        "run": np.array(results.runs),
        "time": ("time", results.times, {"units": "s"}),
        "coordinate": list(results.names),
        "unit": ("coordinate", list(results.units)),
        "phase": list(PHASES),
    }
    root = xr.Dataset(coords=labels, attrs=provenance(results.scenario))
    groups = {
        label: xr.Dataset(
            {
                name: (_FIELDS[name].dims, values, {"meaning": _FIELDS[name].meaning})
                for name, values in record.items()
                if name in _FIELDS
            }
        )
        for label, record in results.records.items()
    }
    return xr.DataTree.from_dict({"/": root, **groups})


def to_dataframe(results: "Results") -> "pd.DataFrame":
    """One row for each estimator and run.

    The columns are the quantities of a run as the store names them (`anees`, `anis`, `diverged`,
    `log_likelihood`, ...; `cpu_time` in s) and `rmse COORDINATE` in the unit of the coordinate.
    """
    import pandas as pd  # xarray needs it, but `import estbench` does not

    tables = {}
    for label, record in results.records.items():
        columns = {
            name: values
            for name, values in record.items()
            if name in _FIELDS and _FIELDS[name].dims == RUN
        }
        rmse = np.sqrt(record["mse"])
        columns |= {f"rmse {name}": rmse[:, i] for i, name in enumerate(results.names)}
        tables[label] = pd.DataFrame(columns, index=pd.Index(results.runs, name="run"))
    return pd.concat(tables, names=["estimator"])
