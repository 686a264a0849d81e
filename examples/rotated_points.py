"""Why the points of `rotated_ukf` are rotated: `python examples/rotated_points.py contact.png`.

A coordinate of standard deviation 1 falls freely down to a floor one standard deviation below its
mean and stops there: h⁺ = max(h, floor). The direction of h in the whitened state lies between the
axes of a fixed rule, whose points touch the floor on no axis. Left: the points in two dimensions.
Right: the error of the predicted mean of h⁺ in n dimensions, step after step. There is no point at
the centre, as in the UKF with its default settings.
"""

import sys

import numpy as np
from scipy import stats

from estbench.estimators.sigma_points import symmetric
from estbench.randomness import counter
from estbench.randomness.orthogonal import haar

N, STEPS, FLOOR = 28, 60, -1.0
EXACT = FLOOR * stats.norm.cdf(FLOOR) + stats.norm.pdf(FLOOR)
"""E max(h, floor) of a standard normal h."""


def errors(n: int = N, steps: int = STEPS) -> tuple[float, np.ndarray]:
    """Error of the predicted mean of max(h, floor): of the fixed rule, and of each rotation."""
    direction = np.full(n, 1 / np.sqrt(n))
    keys, steps_ = counter.default_keys(1).repeat(steps), np.arange(steps, dtype=np.uint64)
    found = []
    for axes in (np.eye(n)[None], haar(keys, steps_, 0, 1, n)):
        rule = symmetric(axes)
        found.append(np.maximum(rule.points @ direction, FLOOR) @ rule.mean_weights - EXACT)
    return float(found[0]), found[1]


def main(path: str) -> None:
    """Draw the picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.16, 2.7), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.7))
    circle, direction = np.linspace(0, 2 * np.pi, 200), np.full(2, np.sqrt(0.5))
    left.plot(np.cos(circle), np.sin(circle), color="#777777", lw=0.9)
    along = np.array([-3.0, 3.0])
    edge = FLOOR * direction[:, None] + np.outer([1, -1], along)
    left.fill_between(edge[0], edge[1], -4, color="#cccccc", lw=0)
    left.text(-1.9, -1.85, "contact", fontsize=8, color="#555555")
    keys = counter.default_keys(1)
    fixed = symmetric(np.eye(2)[None]).points
    left.plot(*fixed.T, "s", color="#0072B2", ms=5, label="fixed axes")
    for step, fill in ((0, "full"), (5, "none")):
        points = symmetric(haar(keys, np.full(1, step, np.uint64), 0, 1, 2)).points[0]
        left.plot(*points.T, "o", color="#D55E00", ms=4.5, fillstyle=fill,
                  label=f"rotated, step {'k' if fill == 'full' else 'k + 1'}")  # fmt: skip
    left.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal", xlabel="ξ₁", ylabel="ξ₂")
    left.legend(fontsize=6.5, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False,
                handletextpad=0.2, columnspacing=0.8)  # fmt: skip

    steps = np.arange(1, STEPS + 1)
    same, each = errors()
    right.axhline(0, color="#777777", ls="--", lw=0.9)
    right.plot(steps, np.full(STEPS, same), color="#0072B2", label="fixed axes")
    right.plot(steps, each, ".", color="#D55E00", ms=4, label="rotated, each step")
    right.plot(steps, each.cumsum() / steps, color="#D55E00", label="rotated, mean so far")
    right.set(xlabel="step", ylabel="error of the mean of h⁺, σ")
    right.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    for axes in (left, right):
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=200, metadata={"Software": None})


if __name__ == "__main__":
    main(sys.argv[1])
