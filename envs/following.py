"""What sensors and filters are given of each environment: its inputs, and the model that it has."""

import logging
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from estbench.envs.errors import EnvError
from estbench.errors import ScenarioError
from estbench.robots import fields, given, parameters
from estbench.robots.backend import Backend
from estbench.robots.controls import ControlRange
from estbench.robots.fields import Fields
from estbench.robots.model import MujocoModel
from estbench.shapes import Array

_log = logging.getLogger("estbench")
_SHOWN = 4
_INPUTS = {
    "qfrc_applied": "applies generalized forces (qfrc_applied)",
    "xfrc_applied": "applies forces to bodies (xfrc_applied)",
    "eq_active": "switches equality constraints (eq_active)",
}


class Following:
    """Rows of environments whose inputs and models may change.

    The sensors see the environment as it is. The filters see the controls, mocap poses and equality
    constraints; where they follow, the applied forces and the parameters of the model too.

    Args:
        name: of the environment, for messages.
        model: the adopted model, which the sensors start with.
        sensors: the backend of the sensors.
        believed: the filters' model, or None without filters.
        model_set: where it differs from that of the environment.
        follow: whether the filters' model follows that of the environment.
        rows: how many environments.
        window: physics steps for which what is past may be computed again.

    Attributes:
        notices: what was found, one line each.
    """

    def __init__(
        self,
        name: str,
        model: mujoco.MjModel,
        sensors: Backend,
        believed: MujocoModel | None,
        model_set: Mapping[str, float | Sequence[float]],
        follow: bool,
        rows: int,
        window: int,
    ):
        self._name, self._model, self._set = name, model, dict(model_set)
        self._reference = fields.Reference(model)
        self._sensors, self._believed, self._follow = sensors, believed, follow
        self._window, self._nu = window, model.nu
        self._rest, self._columns = given.at_rest(model)[self._nu :], given.columns(model)
        one = ControlRange.of(model)
        self._range = ControlRange(np.tile(one.low, (rows, 1)), np.tile(one.high, (rows, 1)))
        self._numbers, self._last = np.zeros(rows), 0
        self._past: dict[int, int] = {}  # number -> tick after which no row has it
        self._plain, self._untouched = not model.nmocap, np.tile(self._rest, rows).tobytes()
        self._noted: set[str] = set()
        self.notices: tuple[str, ...] = ()
        if model.nmocap:
            self._note(
                f"mocap bodies ({', '.join(given.mocap_names(model))}) are known inputs: the "
                "filter follows their poses"
            )

    def adapt(self, row: int, new: Fields, tick: int) -> None:
        """A row has a model with these fields from now on.

        Raises:
            EnvError: a field cannot be followed.
        """
        try:
            differences = self._reference.differences(new)
        except ScenarioError as error:
            raise EnvError(f"{self._name} has changed its model: {error}") from None
        if "opt.timestep" in differences:
            raise EnvError(
                f"{self._name} has changed its timestep to {differences['opt.timestep']:g} s; a "
                "filter cannot follow it: make a new one"
            )
        before, self._numbers = self._numbers[row], self._numbers.copy()
        self._numbers[row], model = 0, self._model
        if differences:
            self._plain, self._last = False, self._last + 1
            self._numbers[row], model = self._last, fields.given(self._model, differences)
            self._sensors.follow(self._last, model)
            if self._believed is not None and self._follow:
                own = parameters.changed(model, self._set, "model_set")
                self._believed.follow(self._last, own)
            self._note_model(differences)
        limits = ControlRange.of(model)
        self._range.low[row], self._range.high[row] = limits.low, limits.high
        if before and before not in self._numbers:
            self._past[int(before)] = tick + self._window
        self._forget(tick)

    def inputs(self, values: Array) -> tuple[Array, Array]:
        """U of the sensors and u of the filters, from all inputs of all rows `(row, inputs)`."""
        nu = self._nu
        u = self._range.clamp(values[:, :nu])
        if self._plain:
            if values[:, nu:].tobytes() == self._untouched:
                return u, u
            self._plain = False
        columns = self._columns
        for name, what in _INPUTS.items():
            if name not in self._noted:
                rest = self._rest[columns[name].start - nu : columns[name].stop - nu]
                if np.count_nonzero(values[:, columns[name]] != rest):
                    known = self._follow or name == "eq_active"
                    end = "the filter knows it" if known else "the filter does not know it"
                    self._note(f"the environment {what}; {end}", name)
        true = np.concatenate([u, values[:, nu:], self._numbers[:, None]], axis=1)
        if self._follow:
            return true, true
        own = true.copy()
        own[:, columns["qfrc_applied"]], own[:, columns["xfrc_applied"]], own[:, -1] = 0, 0, 0
        return true, own

    def close(self) -> None:
        """Release the filters' model."""
        self._believed = None

    def _forget(self, tick: int) -> None:
        """Drop the models that nothing can need any more."""
        for number in [n for n, end in self._past.items() if end < tick]:
            del self._past[number]
            self._sensors.follow(number, None)
            if self._believed is not None:
                self._believed.follow(number, None)

    def _note_model(self, differences: Fields) -> None:
        derived = self._model._setconst_outputs
        names = [n for n in differences if n not in derived] or list(differences)
        if set(names) <= self._noted:
            return
        shown = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
        does = (
            "the filter follows it (model='nominal' keeps the first)"
            if self._follow
            else "the filter keeps the first"
        )
        self._note(f"the environment changes its model ({shown}); {does}", *names)

    def _note(self, line: str, *subjects: str) -> None:
        self._noted.update(subjects)
        self.notices += (line,)
        _log.warning("%s: %s", self._name, line)
