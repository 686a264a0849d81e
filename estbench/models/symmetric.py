"""A model that moves alike from states that differ by a symmetry, as a robot on level ground."""

from typing import Protocol, runtime_checkable

from estbench.models.protocol import Model
from estbench.shapes import Array, Float


class Symmetries(Protocol):
    """The directions of the symmetries of a transition."""

    @property
    def count(self) -> int:
        """How many there are."""
        ...

    def __call__(self, x: Float[Array, "run nx"]) -> Float[Array, "run n k"]:
        """Tangents at x, as columns: a state moved along them moves on along them."""
        ...


@runtime_checkable
class SymmetricModel(Model, Protocol):
    """A model that knows its symmetries."""

    @property
    def symmetries(self) -> Symmetries:
        """The symmetries of the transition.

        Raises:
            ScenarioError: it has none.
        """
        ...
