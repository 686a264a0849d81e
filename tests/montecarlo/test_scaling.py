import pytest

from estbench.errors import ExecutorError
from estbench.experiment import setup
from estbench.montecarlo import executors, scaling
from estbench.montecarlo.forecast import Forecast
from estbench.montecarlo.run import resolve
from estbench.montecarlo.scaling import choose, thread_speed


def test_threads_that_queue_for_a_lock():
    assert thread_speed(0.0, 16) == pytest.approx(16)
    assert thread_speed(1.0, 16) == pytest.approx(1)
    assert thread_speed(0.4, 1) == pytest.approx(1)
    assert thread_speed(0.4, 2) == pytest.approx(2 / (0.6 + 0.4 * 1.4))
    assert thread_speed(0.4, 64) == pytest.approx(1 / 0.4, rel=1e-6)


@pytest.mark.parametrize(
    ("seconds", "locked", "workers", "cpus", "starts", "kind"),
    [
        (100.0, 0.4, 2, 2, 2.0, "both"),
        (2.0, 0.4, 2, 2, 2.0, "threads"),  # over before a process has started
        (2.0, 0.4, 2, 2, 0.0, "both"),  # which stands from before
        (100.0, 0.02, 2, 2, 2.0, "threads"),  # nobody waits for the lock
        (100.0, 0.15, 16, 16, 30.0, "both"),
        (10.0, 0.15, 16, 2, 30.0, "threads"),  # the start of fifteen on two cores
        (100.0, 0.4, 1, 2, 0.0, "threads"),
        (100.0, None, 16, 16, 30.0, "threads"),  # not measured: it is short
    ],
)
def test_processes_are_taken_where_they_finish_first(seconds, locked, workers, cpus, starts, kind):
    assert choose(Forecast(seconds, 1e-5, 0, None, locked), workers, cpus, starts) == kind


def test_there_are_no_more_workers_than_batches_and_by_auto_than_cpus(monkeypatch):
    made = setup.build(resolve("pendulum", ["ekf"], runs=100))
    monkeypatch.setattr(executors, "cpu_count", lambda: 4)
    for kind, size, count in (
        ("auto", 10, 4),
        ("auto", 50, 2),
        ("threads", 10, 8),
        ("processes", 50, 2),
    ):
        using, _ = scaling.pool(kind, made, 100, size, "summary", 8, None)
        assert using.workers == count
    monkeypatch.setattr(executors, "free_memory", lambda: 3 * executors.PROCESS_BYTES)
    with pytest.raises(ExecutorError, match=r"workers is 8: .* holds 3 processes at most"):
        scaling.pool("processes", made, 100, 10, "summary", 8, None)
