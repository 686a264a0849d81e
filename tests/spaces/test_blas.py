"""OpenBLAS on one thread while something is computed."""

import threading

import pytest

from estbench.spaces import blas


@pytest.fixture
def libraries(monkeypatch):
    """Those that are linked, with two threads each, as if the environment did not say how many."""
    for name in blas.VARIABLES:
        monkeypatch.delenv(name, raising=False)
    blas._libraries.cache_clear()
    found = blas._libraries()
    if not found:
        pytest.skip("another BLAS is linked")
    before = [get() for get, _ in found]
    for _, put in found:
        put(2)
    yield found
    for count, (_, put) in zip(before, found):
        put(count)
    blas._libraries.cache_clear()


def counts(libraries):
    return {get() for get, _ in libraries}


def test_one_thread_until_the_last_is_left(libraries):
    allowed = counts(libraries)  # 1 on a machine with one core
    with blas.one_thread():
        other = threading.Thread(target=enter_and_leave)
        other.start()
        other.join()
        assert counts(libraries) == {1}
    assert counts(libraries) == allowed


def enter_and_leave():
    with blas.one_thread():
        pass


def test_it_is_left_after_an_error(libraries):
    allowed = counts(libraries)
    with pytest.raises(ValueError, match="wrong"), blas.one_thread():
        raise ValueError("wrong")
    assert counts(libraries) == allowed


def test_the_environment_is_obeyed(libraries, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    blas._libraries.cache_clear()
    with blas.one_thread():
        assert not blas._libraries()
