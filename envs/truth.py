"""The true robots of the native environments: many at once, each of which may start anew."""

import numpy as np

from estbench.envs.keys import Keys, Mask, RowNoise, purpose
from estbench.experiment.setup import Setup
from estbench.randomness import counter as random
from estbench.robots import backend, parameters
from estbench.shapes import Array


class TruthRows:
    """Truth, disturbance and drawn parameters of `rows` robots of one scenario.

    What a row does depends on the key of its episode and its controls, on nothing else.

    Args:
        setup: the resolved scenario.
        rows: how many robots.
        nthread: threads of the batch.

    Attributes:
        x: true states `(row, nx)`; NaN where MuJoCo failed, until the row starts anew.
        tick: physics steps since the reset `(row,)`.
    """

    def __init__(self, setup: Setup, rows: int, nthread: int = 1):
        self._model, self._space = setup.plant.model, setup.space
        self._backend, self._count = backend.create(setup.plant.model, nthread), rows
        self._mean, self._factor = setup.mean, np.linalg.cholesky(setup.cov)
        self._disturbance = setup.disturbance
        self._noise = RowNoise(rows, {"process": setup.disturbance.rank})
        self._draws = {
            key: (draw, *parameters.parameter(self._model, key, "truth.draw"))
            for key, draw in setup.scenario.truth.draw.items()
        }
        self._drawn = {
            key: np.repeat(np.asarray(getattr(self._model, field)[index])[None], rows, axis=0)
            for key, (_, field, index) in self._draws.items()
        }
        self.x = np.repeat(setup.mean[None], rows, axis=0)
        self.tick = np.zeros(rows, np.int64)

    def reset(self, mask: Mask, keys: Keys) -> None:
        """Draw initial states, from N(x̂₀, P₀), and parameters of the rows of a mask.

        Args:
            mask: `(row,)`.
            keys: random keys of these rows `(mask.sum(),)`.
        """
        zero = np.zeros(len(keys), np.uint64)
        white = random.normal(keys, zero, purpose("initial"), self._space.n)
        # A stack of small products: one large product would depend on the count of rows.
        self.x[mask] = self._space.plus(self._mean, (self._factor @ white[..., None])[..., 0])
        self.tick[mask] = 0
        self._noise.start(mask, keys)
        for key, (draw, field, index) in self._draws.items():
            values = self._drawn[key]
            nominal = getattr(self._model, field)[index]
            z = random.normal(keys, zero, purpose(f"parameter:{key}"), 1)[:, 0]
            values[mask] = parameters.drawn(nominal, draw.relative_std, draw.std, z)
            self._backend.vary(self._count, field, index, values)

    def step(self, u: Array, nstep: int, mask: Mask | None = None) -> Array:
        """True states `(row, nx)` after physics steps under the clamped controls u `(row, nu)`.

        Rows outside the mask stay where they are.
        """
        timestep = float(self._model.opt.timestep)
        t, dt = self.tick[:, None] * timestep, nstep * timestep
        noise, force, driven = self._disturbance, None, u
        w = np.zeros(0)
        if noise.rank:
            white = self._noise.draw(mask)
            scale = np.sqrt(dt) if noise.kind == "additive" else 1 / np.sqrt(dt)
            root = noise.factor
            if noise.schedule is not None:  # a row has its own time, most have the same
                times, which = np.unique(t[:, 0], return_inverse=True)
                root = np.stack([noise.root(float(now)) for now in times])[which]
            # A stack of small products, as above.
            w = scale * (root @ white[..., None])[..., 0]
            if noise.kind == "force":
                force = w
            elif noise.kind == "actuator":
                driven = u + w
        # A row writes its own time: `t` is broadcast against the rows.
        x = self._backend.step(self.x, driven, t, nstep, force)
        if noise.rank and noise.kind == "additive":
            x = self._space.plus(x, w)
        self.x = x if mask is None else np.where(mask[:, None], x, self.x)
        self.tick += nstep if mask is None else nstep * mask
        return self.x
