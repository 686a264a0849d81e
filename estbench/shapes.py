"""Arrays as types: every array's axes stand in its annotation, `Float[Array, "run n n"]`.

Axes by name: `run`, `nx` (numbers of a state), `n` (its tangent), `nu`, `ny` (numbers of a
measurement), `m` (its tangent), `K` (times). The tests check them when functions are called.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Keys = NDArray[np.uint64]
Ints = NDArray[np.int64]
