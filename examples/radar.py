"""What the radar of radar.toml sees: range (m) and bearing (rad) from the origin."""

import numpy as np


def polar(x, u, t):
    return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], axis=-1)
