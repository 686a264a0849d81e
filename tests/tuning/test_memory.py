import numpy as np
import pytest

from estbench.errors import Interrupted, StoreError
from estbench.tuning.memory import Memory
from estbench.tuning.tune import fit
from tests.tuning import linear


class Counting(linear.Given):
    """Counts candidates, and is interrupted after some sets of them."""

    count, left = 0, 1000

    def __call__(self, candidates):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        self.count += len(candidates)
        return super().__call__(candidates)


def counting(y):
    return Counting(lambda values: linear.KF(linear.model(values)), *linear.prior(), y)


def test_an_interrupted_search_keeps_the_best_and_goes_on_without_repetition(tmp_path):
    y = linear.readings()
    whole = counting(y)
    expected = fit(linear.parameters(), Memory(whole))
    first = counting(y)
    first.left = 8
    part = fit(linear.parameters(), Memory(first, tmp_path))
    assert part.interrupted
    assert part.loss[0] > part.loss[1] > expected.loss[1]
    assert part.uncertainty is None
    second = counting(y)
    again = fit(linear.parameters(), Memory(second, tmp_path))
    assert again.values == expected.values
    assert not again.interrupted
    assert first.count + second.count == whole.count
    assert [s.loss for s in again.problem.trace] == [s.loss for s in expected.problem.trace]


def test_a_damaged_file_is_computed_again(tmp_path):
    source = counting(linear.readings())
    Memory(source, tmp_path)([(0.3, 0.5)])
    (file,) = tmp_path.glob("*.npz")
    file.write_bytes(file.read_bytes()[:100])
    found = Memory(source, tmp_path)([(0.3, 0.5)])
    assert source.count == 2
    assert np.isfinite(found.log_likelihood).all()


def test_nothing_to_keep_and_other_runs(tmp_path):
    source = counting(linear.readings())
    source.left = 0
    with pytest.raises(Interrupted, match="before the first candidate"):
        fit(linear.parameters(), Memory(source))
    Memory(counting(linear.readings()), tmp_path)([(0.3, 0.5)])
    other = linear.given(linear.readings(runs=3))
    with pytest.raises(StoreError, match="is of a tuning with other runs"):
        Memory(other, tmp_path)
