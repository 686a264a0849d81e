"""Cubature Kalman filter (Arasaratnam & Haykin, IEEE Trans. Automatic Control 54(6), 2009)."""

from dataclasses import dataclass

from estbench.estimators.settings import has_model, switch
from estbench.estimators.sigma_points import cubature
from estbench.estimators.ukf import SigmaPointFilter


@dataclass(frozen=True)
class CKF(SigmaPointFilter):
    """Cubature Kalman filter: the third-degree rule, 2 n points of equal positive weight.

    x̂⁻, P⁻ from the propagated points and Q, then new points for ŷ, S and Pxy (Arasaratnam &
    Haykin 2009, appendix A). It is the UKF with α = 1, β = κ = 0, without the point at the centre.

    Cost per step: 2 n transitions and 2 n measurements. Choose it over the UKF in many dimensions:
    it has no setting to tune and no negative weight. Its points are sqrt(n) standard deviations
    from the mean.

    Attributes:
        model: the filter's model.
        redraw: as in `SigmaPointFilter`; the source redraws.
    """

    def __post_init__(self) -> None:
        has_model(self)
        switch(self, "redraw")
        object.__setattr__(self, "rule", cubature(self.model.space.n))
