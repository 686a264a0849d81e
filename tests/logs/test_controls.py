"""The mean of held controls over intervals, against sums over a fine grid."""

import numpy as np
import pytest

from estbench.errors import LogError
from estbench.logs import controls
from estbench.logs.table import from_arrays
from estbench.scenario.log import LogColumns, LogSection

TIMES = np.array([0.0, 0.1, 0.25, 0.3, 0.6])
VALUES = np.array([1.0, -2.0, 0.5, 4.0, 3.0])


def signal(tmp_path, hold, **keys):
    table = from_arrays(tmp_path, {"t": TIMES, "u": VALUES})
    section = LogSection(hold=hold, controls={"motor": LogColumns(columns=["u"])}, **keys)
    return controls.held([table], section, ["motor"])


@pytest.mark.parametrize("hold", ["previous", "next", "linear"])
def test_mean_over_any_interval(tmp_path, hold):
    ends = np.array([0.0, 0.02, 0.1, 0.17, 0.29, 0.3, 0.3, 0.55, 0.6])
    found = controls.over(signal(tmp_path, hold), np.zeros(1), ends)[:, 0]
    fine = np.linspace(0.0, 0.6, 600_001)
    middle = (fine[1:] + fine[:-1]) / 2
    k = np.searchsorted(TIMES, middle)
    values = {"previous": VALUES[k - 1], "next": VALUES[k],
              "linear": np.interp(middle, TIMES, VALUES)}[hold]  # fmt: skip
    for a, b, mean in zip(ends, ends[1:], found):
        if b > a:
            inside = (middle > a) & (middle < b)
            assert mean == pytest.approx(values[inside].mean(), abs=1e-4)


def test_a_constant_control_is_not_rounded(tmp_path):
    (part,) = signal(tmp_path, "previous")
    assert part.mean(TIMES)[:, 0].tolist() == VALUES[:-1].tolist()
    (part,) = signal(tmp_path, "next")
    assert part.mean(TIMES)[:, 0].tolist() == VALUES[1:].tolist()


def test_a_delay_shifts_the_effect(tmp_path):
    late = controls.over(signal(tmp_path, "previous", delay=0.05), np.zeros(1), TIMES + 0.05)
    assert late[:, 0] == pytest.approx(VALUES[:-1])


def test_controls_that_end_before_the_readings(tmp_path):
    ends = np.array([0.0, 0.5, 9.0])
    with pytest.raises(LogError, match=r"row 5, t = 0\.6 s: the controls end here .* t = 9 s"):
        controls.over(signal(tmp_path, "previous"), np.zeros(1), ends)
    held = controls.over(signal(tmp_path, "previous", longest_hold=10.0), np.zeros(1), ends)
    assert held[-1, 0] == pytest.approx((0.1 * 4.0 + 8.4 * 3.0) / 8.5)
