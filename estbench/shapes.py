"""Arrays as types: the axes of an array stand in its annotation, `Float[Array, "run n n"]`.

Axes: `run`; `row`, a robot of an environment or a simulator, which goes from one run to the next;
`time`, the start and the ends of all instants, and `time-1` without the start; `step`, some of the
instants; `block` of time; `point`, several states of one run; `lag` of a correlation; `channel`;
`nx` numbers of a state and `n` of its tangent; `nu` numbers of a control; `ny` numbers of a
measurement and `m` of its tangent;
`k` anything else, and `_` anything, with another length each time.
`...` stands for any number of axes. An axis of one name has one length within a call. The tests
check it (`tests/typecheck.py`). A single axis is written with a space, `" run"`, which linters
need.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt
from numpy.typing import NDArray

__all__ = ["Array", "Bool", "Faults", "Float", "Int", "Ints", "Keys", "Mask", "Shaped", "UInt"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Keys = NDArray[np.uint64]
Ints = NDArray[np.int64]
Faults = NDArray[np.uint8]
