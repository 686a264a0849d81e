"""The player of `estbench view`: runs are simulated ahead and played in real time."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estbench.errors import EstbenchError
from estbench.experiment import setup
from estbench.montecarlo import run as experiment
from estbench.report.rendering.replay import Replay, simulated
from estbench.scenario.channels import ChannelSection
from estbench.scenario.schema import Scenario

KEYS = {
    "space": "pause or go on",
    "[ and ]": "half or double the sensors' noise, for robot and filter",
    "- and =": "half or double the filter's Q",
    ", and .": "a frame back or on (while it pauses)",
    "n": "next run",
    "r": "this run from its start",
}
COMMANDS = {
    " ": "pause", "[": "noise-", "]": "noise+", "-": "q-", "=": "q+", ",": "back", ".": "on",
    "n": "next", "r": "restart",
}  # fmt: skip
FRAME = 1 / 60
"""Duration of one frame, s."""


@dataclass(frozen=True)
class Settings:
    """Settings that keys change.

    Attributes:
        run: number of the run.
        noise: factor on the standard deviation of every sensor's white noise.
        q: factor on the filter's Q.
    """

    run: int
    noise: float = 1.0
    q: float = 1.0


class Player:
    """Plays runs in order; after a change by a key the run is simulated again in the background.

    The truth of a run does not depend on the filter's Q, so the new estimate is shown at the time
    of the key. Other sensor noise changes the truth only if the controller uses the estimate.

    Args:
        source: bundled name, TOML or MJCF path.
        estimator: label; default the first.
        run: number of the first run.
        overrides: `section.key=value` strings.

    Raises:
        EstbenchError: the scenario is wrong; the first run is simulated here.
    """

    def __init__(
        self, source: str | Path, estimator: str | None, run: int, overrides: Sequence[str] = ()
    ):
        if run < 0:
            raise EstbenchError(f"--run is {run}; runs are numbered from 0")
        chosen = [estimator] if estimator else None
        self._scenario = experiment.resolve(source, chosen, overrides=overrides)
        self._label = next(iter(self._scenario.estimators))
        self._channels = {c.name: c.cov for c in setup.build(self._scenario).channels}
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="estbench-view")
        self._future: Future[Replay] | None = None
        self._wanted = self.settings = Settings(run)
        self.replay = self._simulate(self.settings)
        self.time = 0.0
        self.paused = False
        self.problem = ""

    @property
    def step(self) -> int:
        """Index of the instant that is shown."""
        return int(np.searchsorted(self.replay.times, self.time + 1e-9, side="right")) - 1

    @property
    def busy(self) -> bool:
        """Whether a run is being simulated."""
        return self._future is not None

    def advance(self, seconds: float) -> None:
        """Advance the time by some seconds; the next run begins at the end of a run."""
        if self._future is not None and self._future.done():
            self._take(self._future)
        if self.paused:
            return
        end = float(self.replay.times[-1])
        self.time = min(self.time + seconds, end)
        if self.time >= end and not self.busy:
            self._want(replace(self._wanted, run=self._wanted.run + 1))

    def command(self, name: str) -> None:
        """Execute one of the values of `COMMANDS`; others are ignored."""
        wanted = self._wanted
        if name == "pause":
            self.paused = not self.paused
        elif name in ("noise+", "noise-"):
            self._want(replace(wanted, noise=wanted.noise * (2 if name[-1] == "+" else 0.5)))
        elif name in ("q+", "q-"):
            self._want(replace(wanted, q=wanted.q * (2 if name[-1] == "+" else 0.5)))
        elif name == "next":
            self._want(replace(wanted, run=wanted.run + 1))
        elif name == "restart":
            self.time = 0.0
        elif name in ("back", "on") and self.paused:
            by = FRAME if name == "on" else -FRAME
            self.time = float(np.clip(self.time + by, 0.0, self.replay.times[-1]))

    def lines(self) -> list[str]:
        """The lines of text of the view: run, time, NEES/n, settings, error."""
        nees = self.replay.nees[self.step]
        low, high = self.replay.band
        word = "in" if low <= nees <= high else "outside"
        out = [
            f"{self.replay.name}: {self.replay.label}, run {self.replay.run}",
            f"t = {self.time:.2f} of {self.replay.times[-1]:g} s"
            + ("  (pause)" if self.paused else ""),
            f"NEES/n = {nees:.3g}, {word} its {self.replay.level:.0%} band",
            f"noise x {self.settings.noise:g}, Q x {self.settings.q:g}"
            + ("  (simulating)" if self.busy else ""),
        ]
        return [*out, self.problem] if self.problem else out

    def close(self) -> None:
        """End the background thread."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _want(self, settings: Settings) -> None:
        """Start the simulation of a run; a simulation that still waits is cancelled."""
        self._wanted = settings
        if self._future is not None:
            self._future.cancel()
        self._future = self._pool.submit(self._simulate, settings)

    def _take(self, future: "Future[Replay]") -> None:
        """Show a simulated run: at the current time, or from its start if its number is new."""
        self._future = None
        if future.cancelled():
            return
        try:
            self.replay = future.result()
        except EstbenchError as error:
            self.problem, self._wanted = str(error), self.settings
            self.paused = True
            return
        self.problem = ""
        if self._wanted.run != self.settings.run:
            self.time = 0.0
        self.settings = self._wanted

    def _simulate(self, settings: Settings) -> Replay:
        """Simulate the run of some settings."""
        return simulated(scaled(self._scenario, self._channels, settings), settings.run,
                         self._label)  # fmt: skip


def scaled(scenario: Scenario, channels: dict, settings: Settings) -> Scenario:
    """The scenario with the sensors' noise and the filter's Q scaled.

    Args:
        scenario: the original scenario.
        channels: name -> R `(m, m)` of the channels in use.
        settings: the factors.
    """
    belief = scenario.filter.model_copy(
        update={"process_noise_scale": scenario.filter.process_noise_scale * settings.q}
    )
    sections = dict(scenario.channels)
    if settings.noise != 1.0:
        for name, cov in channels.items():
            section = sections.get(name) or ChannelSection.model_validate({})
            scaled_cov = (settings.noise**2 * cov).tolist()
            sections[name] = section.model_copy(
                update={"cov": scaled_cov, "noise": None, "noise_density": None}
            )
    return scenario.model_copy(update={"filter": belief, "channels": sections})
