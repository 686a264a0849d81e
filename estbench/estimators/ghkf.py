"""Gauss-Hermite Kalman filter (Ito & Xiong, IEEE Trans. Automatic Control 45(5), 2000)."""

from dataclasses import dataclass

from estbench.errors import EstimatorError
from estbench.estimators.settings import has_model, switch, whole
from estbench.estimators.sigma_points import gauss_hermite
from estbench.estimators.ukf import SigmaPointFilter

MOST_POINTS = 5000


@dataclass(frozen=True)
class GHKF(SigmaPointFilter):
    """Gauss-Hermite Kalman filter: a product rule of orderⁿ points, the reference for small n.

    Every Gaussian expectation in x̂⁻, P⁻, ŷ, S, Pxy is a sum over orderⁿ points, exact where the
    integrand is a polynomial of degree 2 order - 1 in each coordinate (Ito & Xiong 2000).

    Cost per step: orderⁿ transitions and orderⁿ measurements. Choose it to see how much of
    the error of another filter is due to its rule, not to the Gaussian assumption.

    Attributes:
        model: the filter's model.
        redraw: as in `SigmaPointFilter`.
        order: points per dimension, at least 2.

    Raises:
        EstimatorError: orderⁿ is above 5000.
    """

    order: int = 3

    def __post_init__(self) -> None:
        has_model(self)
        switch(self, "redraw")
        whole(self, "order", 2, 100)
        n = self.model.space.n
        if self.order**n > MOST_POINTS:
            raise EstimatorError(
                f"GHKF: order is {self.order} and the state has {n} dimensions, which takes "
                f"{self.order}^{n} points (at most {MOST_POINTS}); lower the order or use the "
                f"estimator 'ckf'"
            )
        object.__setattr__(self, "rule", gauss_hermite(n, self.order))
