"""The true robots: initial states, disturbances and parameters of many rows, and their sensors."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from estbench.randomness import streams
from estbench.randomness.row_draws import BLOCK, RowDraws
from estbench.randomness.streams import Seeds
from estbench.robots import backend, parameters
from estbench.robots.controls import ControlRange
from estbench.robots.disturbance import Disturbance
from estbench.scenario.schema import Draw
from estbench.sensors.channel import Channel
from estbench.sensors.clock import Clocks, Event
from estbench.sensors.delivery import Delivery
from estbench.sensors.suite import SensorSuite
from estbench.sensors.timing import Instant, Schedule
from estbench.shapes import Array, Float, Int, Ints
from estbench.simulation.initial import InitialStates
from estbench.spaces.manifold import Manifold


class Simulator:
    """The true robots of a scenario as rows, each of which may begin an episode at any time.

    An episode is a run: every random number comes from the run's own streams, so a run is the same
    whichever estimator watches it and whichever rows are simulated with it.

    Args:
        model: compiled truth model.
        space: its state space.
        channels: sensors in use.
        schedule: the instants of an episode.
        disturbance: the true process noise.
        initial: how the states at the start are drawn.
        draws: model parameters drawn once per run.
        rows: how many robots.
        instants: all instants of an episode, where it has an end.
        nthread: threads of the physics.
        look: whether every episode begins with a look at all channels (see `SensorSuite`).
        timed: whether whoever follows the robots depends on the time.
        seen: whether the sensors see the disturbance of the interval at whose end they are read.

    Attributes:
        x: true states `(row, nx)`; NaN from where MuJoCo failed until the row begins anew.
        clocks: where each row is in its episode.
        suite: the sensors.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: Manifold,
        channels: Sequence[Channel],
        schedule: Schedule,
        disturbance: Disturbance,
        initial: InitialStates,
        draws: Mapping[str, Draw],
        rows: int,
        instants: Sequence[Instant] | None = None,
        nthread: int | None = 1,
        look: bool = False,
        timed: bool = False,
        seen: bool = False,
    ):
        self._model, self._space, self._disturbance = model, space, disturbance
        self._seen = seen
        self._initial = initial.sampler(model, space)
        self._backend, self._range = backend.create(model, nthread), ControlRange.of(model)
        self.clocks = Clocks(rows, schedule, timed)
        count = BLOCK if instants is None else len(instants)
        self._process = RowDraws(rows, {"process": disturbance.rank}, block=count)
        last = None if instants is None else instants[-1].tick
        self.suite = SensorSuite(model, self._backend, channels, rows, last, look)
        self._draws = {
            key: (draw, *parameters.parameter(model, key, "truth.draw"))
            for key, draw in draws.items()
        }
        self._drawn = {
            key: np.repeat(np.asarray(getattr(model, field)[index])[None], rows, axis=0)
            for key, (_, field, index) in self._draws.items()
        }
        self.x = np.repeat(initial.mean[None], rows, axis=0)

    def start(
        self,
        rows: Int[Ints, " k"],
        seed: Seeds,
        runs: Sequence[int],
        u: Float[Array, "row nu"],
    ) -> None:
        """Begin episodes in some rows: x₀ and parameters are drawn.

        Args:
            rows: their numbers.
            seed: of all of them, or one for each.
            runs: the number of the run in each.
            u: controls of all rows before the first step `(row, nu)`.
        """
        white = streams.normals(seed, runs, "initial", 1, self._space.n)[0]
        self.x = self.x.copy()  # the last may be recorded
        self.x[rows] = self._initial(white)
        self._process.start(rows, seed, runs)
        for key, (draw, field, index) in self._draws.items():
            spread = draw.relative_std, draw.std
            *_, values = parameters.of_runs(self._model, key, spread, seed, runs)
            self._drawn[key][rows] = values
            self._backend.vary(len(self.x), field, index, self._drawn[key])
        self.clocks.start(rows)
        self.suite.start(rows, seed, runs, self.clocks.tick, self.x, u)

    def close(self) -> None:
        """Release the backends."""
        self._initial.close()
        self._backend.close()

    def advance(self, event: Event, u: Float[Array, "row nu"]) -> list[Delivery]:
        """Step some rows under controls u `(row, nu)`, and read what arrives.

        Unless `seen` the sensors are read under the commanded control, without the disturbance: an
        accelerometer that sees the white force correlates v with w, for which the filter's state
        needs the disturbance (`models.seen_noise`).
        """
        u = self._range.clamp(u)
        start, end = self.clocks.time(event)
        noise, force, driven, w = self._disturbance, None, u, None
        if noise.rank:
            w = noise.sample(self._process.draw(event.rows), start, end - start)
            if noise.kind == "force":
                force = w
            elif noise.kind == "actuator":
                driven = u + w
        x = self._backend.step(self.x, driven, start, event.instant.nstep, force)
        if w is not None and noise.kind == "additive":
            x = self._space.plus(x, w)
        self.x = x if event.rows is None else np.where(event.rows[:, None], x, self.x)
        if self._seen:
            return self.suite.read(event.tick, end, self.x, driven, event.rows, force)
        return self.suite.read(event.tick, end, self.x, u, event.rows)
