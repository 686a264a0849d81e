"""Filters between a vector of ordinary MuJoCo environments and its policy."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from estbench.envs.actions import check_finite
from estbench.envs.copies import carried, restore
from estbench.envs.episodes import Episodes
from estbench.envs.errors import EnvError, not_running
from estbench.envs.member import Member, state_of
from estbench.envs.place import Given, Place
from estbench.envs.rows import add_final, reset_mask, row_seeds, vector_info
from estbench.envs.truth_info import MODEL, STATE
from estbench.envs.twin import Twin, chosen
from estbench.envs.watch import Watch
from estbench.robots import fields
from estbench.shapes import Array, Mask
from estbench.spaces.linalg import quiet

States = tuple[Array, Array, Array]  # times, true states, inputs
_log = logging.getLogger("estbench")


class VectorEstimatedObservation(VectorWrapper):
    """`EstimatedObservation` for `SyncVectorEnv`, `AsyncVectorEnv`: one batch of filters.

    Row i with seed s sees what `EstimatedObservation` sees with seed s + i. The filters use the
    first environment's model. The filter of a row begins anew with each episode, in every autoreset
    mode; `SameStep` needs the wrapper `RecordTruth` in each environment.

    Args:
        env: the vector of environments.
        estimator, sensors, process_noise, observe, initial_std, model_set, frame_skip: as for
            `estbench.envs.EstimatedObservation`. With `observe="env"` each row's observation is
            computed in Python, one after the other; the other kinds are computed together.
        model, data: likewise; a place is a function of the unwrapped environment, and environments
            in other processes need `RecordTruth` with the same place.
        nthread: threads of the filters' physics.

    Raises:
        EstbenchError: a setting is wrong; the message names the remedy.
    """

    def __init__(
        self,
        env: VectorEnv,
        estimator: str | Mapping[str, Any] = "ukf",
        sensors: str | Path | Sequence[str] | Mapping[str, Any] | None = None,
        process_noise: float | Mapping[str, Any] = 0.01,
        observe: str | None = None,
        initial_std: float | Sequence[float] | dict[str, float] | None = None,
        model_set: Mapping[str, float | Sequence[float]] | None = None,
        model: Given = "follow",
        data: Given = None,
        frame_skip: int | None = None,
        nthread: int = 1,
    ):
        super().__init__(env)
        inner = env.unwrapped
        if isinstance(inner, SyncVectorEnv):
            members, here = list(inner.envs), True
        elif isinstance(inner, AsyncVectorEnv):
            members, here = [inner.env_fns[0]()], False
        else:
            raise EnvError(
                f"{type(inner).__name__} is neither SyncVectorEnv nor AsyncVectorEnv; make it with "
                "gymnasium.make_vec(..., vectorization_mode='sync')"
            )
        self._places = [Place(member, model, data) for member in members]
        first, skip = Member(members[0], self._places[0]), self._places[0].frame_skip(frame_skip)
        self._members = [first, *map(Member, members[1:], self._places[1:])] if here else []
        observe, self._said = chosen(observe, members[0])
        self._watch = Watch(
            first, env.num_envs, estimator, sensors, process_noise, initial_std, model_set,
            model != "nominal", skip, filtered=observe != "raw", nthread=nthread,
        )  # fmt: skip
        for line in self._said:
            _log.warning("%s: %s", type(members[0].unwrapped).__name__, line)
        self._twins: list[Twin] = []
        if observe == "env":
            every = members if len(members) == env.num_envs else members * env.num_envs
            self._twins = [Twin(member) for member in every]
            self.single_observation_space = self._twins[0].space
        else:
            self._observe = self._watch.features(observe)
            self.single_observation_space = self._observe.space
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._episodes = Episodes(env.num_envs)
        self._ended = np.zeros(env.num_envs, bool)
        self._shown = np.zeros((env.num_envs, *(self.single_observation_space.shape or ())))
        self._time, self._fresh = np.zeros(env.num_envs), np.zeros(env.num_envs, bool)
        self._closed = False

    @property
    def notices(self) -> tuple[str, ...]:
        """What was assumed, and what was found since, one line each; the log has them too."""
        return (*self._watch.notices, *self._said)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start episodes and filters, in all rows or those of `options["reset_mask"]`."""
        if self._closed:
            raise not_running(True)
        mask, seeds = reset_mask(options, self.num_envs), row_seeds(seed, self.num_envs)
        _, info = self.env.reset(seed=seed, options=options)  # pyright: ignore[reportArgumentType]
        for row in np.flatnonzero(mask).tolist():
            self._episodes.seed(row, seeds[row])
        states = self._states(info, mask, np.zeros_like(mask))
        self._restart(mask, states)
        return self._shown.copy(), {**info, **self._info(states, mask)}

    def step(self, actions: Any) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
        """Step all environments, predict and update all filters.

        Raises:
            EnvError: an action is not finite or of another shape, or what the rows need cannot be
                known.
        """
        if self._closed:
            raise not_running(True)
        space = self.single_action_space
        if isinstance(space, gym.spaces.Box):
            shape = (self.num_envs, *space.shape)
            check_finite(np.asarray(actions, np.float64), shape)  # MuJoCo clamps
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise EnvError(
                f"step() after the end of the episode of row {int(self._ended.argmax())}; call "
                "reset(options={'reset_mask': terminated | truncated})"
            )
        _, reward, terminated, truncated, info = self.env.step(actions)
        over, every = terminated | truncated, np.ones(self.num_envs, bool)
        again = self._ended if self._mode is AutoresetMode.NEXT_STEP else ~every
        if self._mode is AutoresetMode.SAME_STEP and over.any():
            last = self._final_states(info, over)
            self._follow(last, every)
            final, before = self._shown.copy(), self._info(last, over)
            states = self._states(info, over, ~over)
            self._restart(over, states)
            final_info = {**info["final_info"], **before}
            ours = self._info(states, every)
            add_final(ours, over, final, final_info)
            return self._shown.copy(), reward, terminated, truncated, {**info, **ours}
        states = self._states(info, again, ~every)
        self._follow(states, ~again)
        if again.any():
            self._restart(again, states)
        self._ended = over
        info = {**info, **self._info(states, every)}
        return self._shown.copy(), reward, terminated, truncated, info

    def __getstate__(self) -> dict[str, Any]:
        """The wrapper, and what copies of the environments lack.

        Raises:
            EnvError: the environments live in other processes.
        """
        inner = self.env.unwrapped
        if not isinstance(inner, SyncVectorEnv):
            raise EnvError(
                f"{type(inner).__name__} runs in other processes and cannot be copied; use "
                "gymnasium.make_vec(..., vectorization_mode='sync')"
            )
        state = {k: v for k, v in vars(self).items() if k not in ("_members", "_twins")}
        twins = [twin.data for twin in self._twins]
        return {"state": state, "carried": [carried(e) for e in inner.envs], "twins": twins}

    def __setstate__(self, copied: dict[str, Any]) -> None:
        vars(self).update(copied["state"])
        members = self.env.unwrapped.envs  # pyright: ignore[reportAttributeAccessIssue]
        for member, attributes in zip(members, copied["carried"]):
            restore(member, attributes)
        self._members = list(map(Member, members, self._places))
        self._twins = [Twin(e, data) for e, data in zip(members, copied["twins"])]

    def close(self, **kwargs: Any) -> None:
        """Close the environments; nothing can follow."""
        self._closed = True
        self._watch.close()
        self.env.close(**kwargs)

    def _restart(self, mask: Mask, states: States) -> None:
        t, x, u = states
        rows = np.flatnonzero(mask)
        self._watch.reset(rows, *self._episodes.next(rows), x, u)
        self._time[mask], self._ended = t[mask], self._ended & ~mask
        self._fresh |= mask
        filter_ = self._watch.filter
        if self._twins and filter_ is not None:
            for row in np.flatnonzero(mask):
                self._shown[row] = self._twins[row].reset(
                    filter_.estimate[row], x[row], u[row], float(t[row])
                )
        else:
            self._shown[mask] = self._observe(x)[mask]

    def _follow(self, states: States, mask: Mask) -> None:
        """Filters and observations of the rows of a mask after a step."""
        if not mask.any():
            return
        t, x, u = states
        for here in np.flatnonzero(mask & (self._fresh | (t <= self._time))).tolist():
            if self._members:  # those of other processes are not to be had
                self._members[here].check_not_reset()
        self._fresh &= ~mask
        row = int(mask.argmax())
        nstep = self._watch.steps(float(t[row] - self._time[row]))
        filter_ = self._watch.filter
        before = None if filter_ is None else filter_.estimate
        with quiet():
            self._watch.step(nstep, x, u, None if mask.all() else mask)
        self._time[mask] = t[mask]
        if self._twins and filter_ is not None and before is not None:
            for row in np.flatnonzero(mask):
                self._shown[row] = self._twins[row].step(
                    before[row], u[row], nstep, filter_.estimate[row], float(t[row])
                )
        else:
            self._shown[mask] = self._observe(x)[mask]

    def _info(self, states: States, mask: Mask) -> dict[str, Any]:
        with quiet():
            return vector_info(self._watch.info(states[1]), mask)

    def _states(self, info: dict[str, Any], began: Mask, followed: Mask) -> States:
        """Times, true states and inputs of all rows; of rows without news, the last ones.

        Args:
            info: of the vector; what `RecordTruth` has added is taken out.
            began: rows that began an episode.
            followed: rows whose model in `info` is known already.
        """
        if STATE in info:
            new, known = np.asarray(info.pop(STATE)), info.pop(f"_{STATE}")
            self._last = new if known.all() else np.where(known[:, None], new, self._last)
            self._adapt(info, ~followed)
            for key in (MODEL, f"_{MODEL}"):
                info.pop(key, None)
            return self._parts(self._last)
        if self._members:
            for row in np.flatnonzero(began).tolist():
                self._members[row].begin()
            for row, member in enumerate(self._members):
                self._watch.adapt(row, member.changes())
            return self._parts(np.array([member.state() for member in self._members]))
        if not self._places[0].usual:
            raise EnvError(
                "the data of environments in other processes are under another name than `data`; "
                "make the vector with wrappers=[estbench.envs.RecordTruth]"
            )
        datas = self.env.unwrapped.get_attr("data")  # pyright: ignore[reportAttributeAccessIssue]
        for row in np.flatnonzero(began).tolist():
            self._watch.adapt(row, fields.read(datas[row].model))
        return self._parts(np.array([state_of(data) for data in datas]))

    def _parts(self, states: Array) -> States:
        return states[:, 0], *self._watch.divided(states)

    def _adapt(self, info: dict[str, Any], rows: Mask) -> None:
        """Follow the models that `RecordTruth` has sent, of some rows."""
        if MODEL in info:
            for row in np.flatnonzero(info[f"_{MODEL}"] & rows).tolist():
                self._watch.adapt(row, info[MODEL][row].fields)

    def _final_states(self, info: dict[str, Any], over: Mask) -> States:
        """The states before the reset, of the rows that ended in this step."""
        final = info["final_info"]
        if STATE not in final:
            raise EnvError(
                "with same-step autoreset the last state of an episode is gone before a filter can "
                "see it; make the vector with wrappers=[estbench.envs.RecordTruth], or with "
                "autoreset_mode='NextStep'"
            )
        last = np.asarray(final.pop(STATE))
        final.pop(f"_{STATE}")
        self._adapt(final, over)
        self._adapt(info, ~over)
        for key in (MODEL, f"_{MODEL}"):
            final.pop(key, None)
        now = np.asarray(info[STATE])
        return self._parts(np.where(over[:, None], last, now))
