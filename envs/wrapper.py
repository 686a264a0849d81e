"""A filter between any MuJoCo environment and its policy."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from estbench.envs.actions import check_finite
from estbench.envs.copies import carried, restore
from estbench.envs.episodes import Episodes
from estbench.envs.errors import not_running
from estbench.envs.member import Member
from estbench.envs.native import first
from estbench.envs.place import Given, Place
from estbench.envs.twin import Twin, chosen
from estbench.envs.watch import Watch
from estbench.spaces.linalg import quiet

ROW = np.zeros(1, np.int64)
_log = logging.getLogger("estbench")


class EstimatedObservation(gym.Wrapper, RecordConstructorArgs):
    """Shows a policy the estimate of a filter with noisy sensors, in place of the true state.

    The environment itself is not changed: its trajectory for a seed and actions is the same, to the
    last bit, with and without the wrapper. The filter starts at an x̂₀ with x₀ ⊖ x̂₀ ~ N(0, P₀).

    Args:
        env: any environment that has MuJoCo's model and data somewhere.
        estimator: name, `package.module:Name`, or a table of settings with `type`.
        sensors: names of sensors in the model; a table of channels, as in a scenario's
            `[channels.NAME]` (see `estbench.envs.sensors`); or a TOML file of them. By default
            all sensors in the model, or, if it has none, an encoder on every joint and pose and
            gyro on every free body. `noise = 0` makes a channel's reading exact.
        process_noise: spectral density Q_s that the filter assumes: of the velocities (a number,
            (unit/s)²/s), or per coordinate (a table of patterns), or a table with `kind` and
            `density` as in a scenario's `[process_noise]`.
        observe: `env` (the environment's own observation, at the estimate), `state`, `belief`,
            `covariance`, or `raw` (sensor readings, no filter). By default `env`, or `state`,
            with a notice, for an environment that cannot compute its observation at an estimate.
        initial_std: P₀'s standard deviations: a number, a list or a table of patterns; default
            0.05, and 0.005 with equality constraints, along which x̂₀ and P₀ lie. 0 starts the
            filter at the truth.
        model_set: `field.object` = value: where the filter's model differs from the environment's.
        model: what the filter knows when the environment changes its model (parameters that are
            drawn per episode, a body that is moved) or applies forces: `follow` (all of it), or
            `nominal` (it keeps the first model, and knows no forces). Or where MuJoCo's model is,
            which is then followed: the model, an object that has it, or a function of the
            unwrapped environment. By default it is searched.
        data: where MuJoCo's data are, likewise.
        frame_skip: physics steps of a step, for an environment that does not say it. It is needed
            for sensors with a rate or a latency.
        nthread: threads of the filter's physics, on which no result depends; default as many of
            the cores as make it faster, which is timed while it runs.

    Raises:
        EstbenchError: a setting is wrong; the message names the remedy.
    """

    def __init__(
        self,
        env: gym.Env,
        estimator: str | Mapping[str, Any] = "ukf",
        sensors: str | Path | Sequence[str] | Mapping[str, Any] | None = None,
        process_noise: float | Mapping[str, Any] = 0.01,
        observe: str | None = None,
        initial_std: float | Sequence[float] | dict[str, float] | None = None,
        model_set: Mapping[str, float | Sequence[float]] | None = None,
        model: Given = "follow",
        data: Given = None,
        frame_skip: int | None = None,
        nthread: int | None = None,
    ):
        RecordConstructorArgs.__init__(
            self,
            estimator=estimator,
            sensors=str(sensors) if isinstance(sensors, Path) else sensors,
            process_noise=process_noise,
            observe=observe,
            initial_std=initial_std,
            model_set=model_set,
            model=model,
            data=data,
            frame_skip=frame_skip,
            nthread=nthread,
        )
        gym.Wrapper.__init__(self, env)
        place = Place(env, model, data)
        self._place, self._member = place, Member(env, place)
        observe, self._said = chosen(observe, env)
        self._watch = Watch(
            self._member, 1, estimator, sensors, process_noise, initial_std, model_set,
            model != "nominal", place.frame_skip(frame_skip), observe != "raw", nthread,
        )  # fmt: skip
        for line in self._said:
            _log.warning("%s: %s", type(env.unwrapped).__name__, line)
        self._episodes = Episodes(1)
        self._twin = Twin(env) if observe == "env" else None
        if self._twin is None:
            self._observe = self._watch.features(observe)
            self.observation_space = self._observe.space
        self._running = self._closed = False

    @property
    def notices(self) -> tuple[str, ...]:
        """What was assumed, and what was found since, one line each; the log has them too."""
        return (*self._watch.notices, *self._said)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode and the filter; a seed also fixes the sensors' noise.

        Returns:
            The observation, and the environment's info with that of the filter
            (`estbench.inference.live.LiveFilter.info`).
        """
        if self._closed:
            raise not_running(True)
        out: Any = self.env.reset(seed=seed, options=options)
        # Some environments return the observation alone (gym-quadruped).
        info = out[1] if isinstance(out, tuple) and isinstance(out[-1], dict) else {}
        self._episodes.seed(0, seed)
        self._member.begin()
        self._watch.adapt(0, self._member.changes())
        state = self._member.state()
        x, u = self._watch.divided(state[None])
        self._watch.reset(ROW, *self._episodes.next(ROW), x, u)
        self._running, self._fresh, self._time = True, True, state.item(0)
        filter_ = self._watch.filter
        if self._twin is not None and filter_ is not None:
            observation = self._twin.reset(filter_.estimate[0], x[0], u[0], self._time)
        else:
            observation = self._observe(x)[0].copy()
        with quiet():
            return observation, {**info, **first(self._watch.info(x))}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, predict and update.

        Raises:
            EnvError: the action is not finite or of another shape, the episode is over, or the
                environment is closed.
        """
        if not self._running:
            raise not_running(self._closed)
        space = self.action_space  # asked once: every wrapper in between passes it on
        if isinstance(space, gym.spaces.Box):
            check_finite(np.asarray(action, np.float64), space.shape)  # MuJoCo clamps
        _, reward, terminated, truncated, info = self.env.step(action)
        self._running = not (terminated or truncated)
        state = self._member.state()
        now, (x, u) = state.item(0), self._watch.divided(state[None])
        if self._fresh or now <= self._time:
            self._member.check_not_reset()
            self._fresh = False
        self._watch.adapt(0, self._member.changes())
        nstep = self._watch.steps(now - self._time)
        self._time = now
        filter_ = self._watch.filter
        before = None if filter_ is None else filter_.estimate
        with quiet():
            self._watch.step(nstep, x, u)
            news = first(self._watch.info(x))
        if self._twin is not None and filter_ is not None and before is not None:
            observation = self._twin.step(before[0], u[0], nstep, filter_.estimate[0], self._time)
        else:
            observation = self._observe(x)[0].copy()
        return observation, reward, terminated, truncated, {**info, **news}

    def close(self) -> None:
        """Close the environment; nothing can follow."""
        self._running, self._closed = False, True
        self._watch.close()
        super().close()

    def __getstate__(self) -> dict[str, Any]:
        """The wrapper, and what a copy of the environment lacks."""
        state = {k: v for k, v in vars(self).items() if k not in ("_member", "_twin")}
        twin = None if self._twin is None else self._twin.data
        return {"state": state, "carried": carried(self.env), "twin": twin}

    def __setstate__(self, copied: dict[str, Any]) -> None:
        vars(self).update(copied["state"])
        restore(self.env, copied["carried"])
        self._member = Member(self.env, self._place)
        self._twin = None if copied["twin"] is None else Twin(self.env, copied["twin"])
