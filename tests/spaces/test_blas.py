"""BLAS on one thread while something is computed."""

import threading

import pytest
from threadpoolctl import threadpool_limits

from estbench.spaces import blas


@pytest.fixture
def two(monkeypatch):
    """Two threads each, as if the environment did not say how many."""
    for name in blas.VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(2, user_api="blas"):
        yield counts()


def counts():
    found = blas._libraries().select(user_api="blas").info()
    return [library["num_threads"] for library in found]


def test_one_thread_until_the_last_is_left(two):
    assert len(two) > 0
    with blas.one_thread():
        other = threading.Thread(target=enter_and_leave)
        other.start()
        other.join()
        assert set(counts()) == {1}
    assert counts() == two  # 1 on a machine with one core


def enter_and_leave():
    with blas.one_thread():
        pass


def test_it_is_left_after_an_error(two):
    with pytest.raises(ValueError, match="wrong"), blas.one_thread():
        raise ValueError("wrong")
    assert counts() == two


def test_the_environment_is_obeyed(two, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with blas.one_thread():
        assert counts() == two
