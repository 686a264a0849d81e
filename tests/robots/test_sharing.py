import os
import signal

import numpy as np
import pytest

from estbench.robots import backend, sharing
from tests.helpers import random_states, zoo_model


def settled(choices, work, hand_over, now=0.0, calls=60):
    """Threads and time after some calls, where k threads take work / k + hand_over."""
    threads = next(choices) if not now else choices.send((now, now))
    for _ in range(calls):
        took = work / threads + (hand_over if threads > 1 else 0.0)
        threads = choices.send((now, now + took))
        now += took
    return threads, now


@pytest.mark.parametrize(
    ("work", "hand_over", "threads"),
    [
        (2000e-6, 8e-6, 16),
        (400e-6, 8e-6, 8),
        (150e-6, 8e-6, 2),
        (70e-6, 0.0, 1),  # a second thread would have less than 50 µs to do
        (400e-6, 1e-3, 1),  # others have the cores
        (400e-6, 200e-6, 1),  # two threads for none of the time
    ],
)
def test_threads_are_as_many_as_pay(work, hand_over, threads):
    assert settled(sharing.choices(16), work, hand_over)[0] == threads
    assert settled(sharing.choices(1), work, hand_over)[0] == 1


def test_a_busy_machine_is_noticed_after_a_rest():
    choices = sharing.choices(2)
    threads, now = settled(choices, 400e-6, 8e-6)
    assert threads == 2
    assert settled(choices, 400e-6, 1e-3, now, calls=1500)[0] == 1


def test_results_do_not_depend_on_the_threads_that_are_tried(monkeypatch):
    monkeypatch.setattr(sharing, "free_cores", lambda: 4)
    monkeypatch.setattr(sharing, "LEAST", 0.0)
    monkeypatch.setattr(sharing, "PAYS", np.inf)
    model = zoo_model("joints")
    x, u = random_states(model, 6)
    one, shared, used = backend.create(model), backend.create(model, None), set()
    for values in (None, np.full((6, 1), 2.0), np.full((6, 1), 3.0)):
        if values is not None:
            one.vary(6, "body_mass", slice(1, 2), values)
            shared.vary(6, "body_mass", slice(1, 2), values)
        for k in range(3 * sharing.CALLS):
            step = None if k % 2 else 0.5 * model.opt.timestep
            a, b = (e.step(x, u, 0.0, 3, None, step) for e in (one, shared))
            np.testing.assert_array_equal(a, b)
            used.add(shared.batch(6).nthread)
            x = np.where(np.isfinite(a).all(axis=1, keepdims=True), a, x)
    assert used == {1, 2, 4}


def test_workers_of_multiprocessing_have_one_thread(monkeypatch):
    assert sharing.free_cores() == len(os.sched_getaffinity(0))
    monkeypatch.setattr(sharing.multiprocessing, "parent_process", lambda: object())
    assert sharing.free_cores() == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_steps_without_the_threads_of_its_parent():
    model = zoo_model("joints")
    x, u = random_states(model, 6)
    engine = backend.create(model, 2)
    expected = engine.step(x, u, 0.0, 3)
    child = os.fork()
    if not child:
        signal.alarm(10)
        same = np.array_equal(engine.step(x, u, 0.0, 3), expected)
        del engine
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0
