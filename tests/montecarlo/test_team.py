import os
import sys
import types

import numpy as np
import pytest

import estbench
from estbench.consistency.records import COST
from estbench.montecarlo import scaling, team
from estbench.spaces import blas


def number(_=None):
    return os.getpid()


def threads_of_blas():
    return {each["num_threads"] for each in blas._libraries().select(user_api="blas").info()}


@pytest.fixture
def kept():
    made = team.kept(1, 1)
    yield made
    team.dismiss(made)


def elsewhere(of):
    """The process of the spawned worker, once it has started."""
    while (pid := of.submit(number).result()) == os.getpid():
        pass
    return pid


def test_this_process_works_while_the_others_start_and_they_stay(kept, monkeypatch):
    assert kept.submit(number).result() == os.getpid()
    pid = elsewhere(kept)
    assert team.kept(1, 1) is kept
    assert elsewhere(kept) == pid
    monkeypatch.setattr(scaling, "choose", lambda *_: "both")
    options = {"runs": 40, "duration": 0.2, "batch_size": 4, "overrides": ["bound=false"]}
    mixed = estbench.run("pendulum", "ekf", **options, executor="auto", workers=2)
    alone = estbench.run("pendulum", "ekf", **options)
    assert not kept.closed  # it computed them, and stays
    for name in alone.records["ekf"].keys() - COST:
        values = alone.records["ekf"][name]
        np.testing.assert_array_equal(mixed.records["ekf"][name], values, err_msg=name)

    def interrupt(done, total):
        raise KeyboardInterrupt

    left = estbench.run(
        "pendulum", "ekf", **options, executor="auto", workers=2, progress=interrupt
    )
    assert left.interrupted
    assert kept.closed


def test_workers_are_replaced_where_a_file_has_changed(kept, tmp_path, monkeypatch):
    path = tmp_path / "mine.py"
    path.touch()
    module = types.ModuleType("mine")
    module.__file__ = str(path)
    monkeypatch.setitem(sys.modules, "mine", module)
    assert team.kept(1, 1) is kept  # a file that no worker has imported yet
    os.utime(path, (1, 1))
    other = team.kept(1, 1)
    assert other is not kept
    assert kept.closed
    with pytest.raises(RuntimeError, match="dismissed"):
        kept.submit(number)
    team.dismiss(other)


def test_a_spawned_process_has_one_thread_of_blas(monkeypatch):
    for name in blas.VARIABLES:
        monkeypatch.delenv(name, raising=False)
    made = team.Team(0, 1)
    assert made.submit(threads_of_blas).result() == {1}
    made.shutdown()
