"""Random orthogonal matrices that depend on a run's key and counter only."""

import numpy as np

from estbench.randomness import counter as random
from estbench.shapes import Array, Float, Keys, UInt


def haar(
    keys: UInt[Keys, " run"], counter: UInt[Keys, " run"], purpose: int, count: int, n: int
) -> Float[Array, "run count n n"]:
    """Orthogonal matrices U of the Haar measure, the uniform distribution over O(n).

    U D is the Q of the QR factorization of a matrix of independent standard normals, with
    D = sign(diag R), without which the distribution would depend on the factorization (Stewart
    1980; Mezzadri, Notices of the AMS 54(5), 2007).

    Args:
        keys: keys of the random numbers of each run.
        counter: counter of the call.
        purpose: what the numbers are for.
        count: matrices of each run.
        n: their order.
    """
    normals = random.normal(keys, counter, purpose, count, n, n)
    orthogonal, upper = np.linalg.qr(normals)
    return orthogonal * np.sign(np.diagonal(upper, axis1=-2, axis2=-1))[..., None, :]
