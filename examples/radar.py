"""What the radar of radar.toml sees: range (m) and bearing (rad) from the origin."""

import numpy as np


def polar(x, u, t):
    """Range and bearing `(..., 2)` of x = (x, y, vx, vy) `(..., 4)`."""
    return np.stack([np.hypot(x[..., 0], x[..., 1]), np.arctan2(x[..., 1], x[..., 0])], axis=-1)
