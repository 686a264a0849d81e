"""What no sensor of an experiment sees, as a notice."""

import numpy as np

from estbench.errors import ScenarioError
from estbench.experiment.prepared import Setup
from estbench.models import observability
from estbench.spaces.linalg import quiet

_MOST = 250
"""Coordinates, and values of a measurement, beyond which the Gramian takes seconds."""
_LISTED = 6


def notice(prepared: Setup) -> str:
    """One line that names the coordinates that no sensor sees; empty for none.

    Empty too where it would take long to find out, and where the Jacobians at x̂₀ are not finite.
    """
    width = sum(space.n for space in prepared.channel_spaces.values())
    if max(width, prepared.space.n) > _MOST:
        return ""
    scale = np.linalg.norm(prepared.initial.factor, axis=1)  # constraints leave less to see
    known = scale == 0.0
    try:
        with quiet():
            hidden = observability.unseen(
                prepared.model(), prepared.mean, prepared.plant.u0, prepared.plant.period,
                np.where(known, 1.0, scale),
            )  # fmt: skip
    except (ScenarioError, np.linalg.LinAlgError):
        return ""
    exact = {name for name, exactly in zip(prepared.space.names, known) if exactly}
    names = [name for name in hidden if name not in exact]
    if not names:
        return ""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED + 1 else ""
    listed = ", ".join(names[:_LISTED] if more else names)
    return f"no sensor can see {listed}{more} (linearized at the initial state)"
