"""What goes wrong while a batch of runs is under way, and what is left of it then."""

import errno
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zarr

import estbench
from estbench.analysis.compare import compare_stores
from estbench.errors import ExecutorError, StoreError
from estbench.estimators.ekf import EKF
from estbench.montecarlo import dask, dispatch, executors
from estbench.montecarlo.pool import execute
from estbench.store.contents import SCENARIO
from estbench.store.metadata import STORE
from estbench.store.zarr import Store
from tests.stores import run, same


def done(folder) -> int:
    with estbench.open_results(folder) as tree:
        return int(tree["done"].sum())


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole") / "x")


# Killed


KILLED = """
import os, signal, sys
from pathlib import Path
import estbench
from estbench.store.zarr import Store

def die(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)

moment, out = sys.argv[1:]
if moment == "before the first batch":
    Store.write = die
else:  # a chunk of the third batch is written beside its place and not yet in it
    replace, seen = Path.replace, []
    def late(self, target):
        seen.append(target)
        if str(target).endswith("ekf/nees/c/2/0"):
            die()
        return replace(self, target)
    Path.replace = late
estbench.run("pendulum", ["ekf"], runs=40, duration=0.3, batch_size=5, workers=1, out=out)
"""
MOMENTS = {"before the first batch": 0, "within a chunk": 10}


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_and_resumed_the_store_is_the_uninterrupted_one(whole, tmp_path, moment):
    out = tmp_path / "x"
    process = subprocess.run([sys.executable, "-c", KILLED, moment, str(out)], timeout=120)
    assert process.returncode == -signal.SIGKILL
    assert done(out) == MOMENTS[moment]
    assert any(out.rglob("*.partial")) == (moment == "within a chunk")
    totals = set()
    run(out, resume=True, progress=lambda _, total: totals.add(total))
    assert totals == {40 - MOMENTS[moment]} - {0}
    assert not any(out.rglob("*.partial"))
    same(out, whole.folder)


def children(pid: int) -> list[int]:
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(p) for path in found for p in path.read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_processes_do_not_outlive_a_parent_that_was_killed(tmp_path):
    command = [
        sys.executable, "-m", "estbench", "run", "pendulum", "-e", "ekf", "--runs", "100000",
        "--duration", "1", "--keep", "summary", "--executor", "processes", "--workers", "2",
        "--out", str(tmp_path / "x"),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    first = tmp_path / "x" / STORE / "done" / "c" / "0"
    while not first.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    workers = children(process.pid)
    assert len(workers) >= 2
    process.kill()
    process.wait()
    deadline = time.monotonic() + 20
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(alive, workers))
    assert done(tmp_path / "x") > 0


# Two at once


def test_two_shards_in_two_processes_fill_one_store(whole, tmp_path):
    script = (
        "import sys; import estbench; "
        "estbench.run('pendulum', ['ekf'], runs=40, duration=0.3, batch_size=5, "
        "out=sys.argv[1], shard=(int(sys.argv[2]), 2))"
    )
    out = str(tmp_path / "x")
    processes = [subprocess.Popen([sys.executable, "-c", script, out, i]) for i in "12"]
    assert [p.wait(timeout=120) for p in processes] == [0, 0]
    assert done(out) == 40
    same(out, whole.folder)


def test_a_shard_that_fails_leaves_what_the_others_wrote(whole, tmp_path, monkeypatch):
    run(tmp_path / "x", shard=(1, 2))
    shutil.rmtree(tmp_path / "x" / STORE / "done" / "c")  # as if it had only begun

    def fail(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("estbench.store.checksums.write", fail)
    with pytest.raises(StoreError, match="No space left"):
        run(tmp_path / "x", shard=(2, 2))
    monkeypatch.undo()
    assert (tmp_path / "x" / SCENARIO).exists()
    run(tmp_path / "x", resume=True)
    same(tmp_path / "x", whole.folder)


# The disk


def test_a_disk_that_fills_up_keeps_the_finished_runs(whole, tmp_path, monkeypatch):
    put, count, computed = zarr.Array.__setitem__, [0], []

    def full(self, where, value):
        count[0] += 1
        if count[0] > 150:  # some four batches
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        put(self, where, value)

    monkeypatch.setattr(zarr.Array, "__setitem__", full)
    with pytest.raises(StoreError, match=r"No space left on device.*--resume") as caught:
        run(tmp_path / "x", workers=1, progress=lambda done, _: computed.append(done))
    assert f"({computed[-1]} of 40 runs are finished)" in str(caught.value)
    assert count[0] < 160  # the other batches are not computed for nothing
    monkeypatch.undo()
    assert 0 < done(tmp_path / "x") == computed[-1] < 40
    run(tmp_path / "x", resume=True)
    same(tmp_path / "x", whole.folder)


@pytest.mark.parametrize("what", ["store", "folder", "store, while a chunk is written"])
def test_a_store_deleted_while_running_is_said_once(tmp_path, monkeypatch, what):
    zarr_folder = tmp_path / "x" / STORE
    write = Store.write

    def delete(self, *arguments):
        write(self, *arguments)
        shutil.rmtree(tmp_path / "x" if what == "folder" else zarr_folder)
        if "chunk" in what:  # zarr makes the folders of what it writes
            (zarr_folder / "ekf" / "error" / "c").mkdir(parents=True)

    monkeypatch.setattr(Store, "write", delete)
    with pytest.raises(StoreError, match=r"x cannot be written: .*of 40 runs") as caught:
        run(tmp_path / "x", workers=1)
    assert "\n" not in str(caught.value)
    assert "kept" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["ekf/fault/c/3", "ekf/error/c/3/0/0", "truth/x/c/3/0/0", "../costs/3.json"]
)
def test_a_chunk_that_is_missing_is_computed_again_and_said(whole, tmp_path, name):
    # A power cut may lose a file that was written before the mark that says so.
    run(tmp_path / "x")
    (tmp_path / "x" / STORE / name).unlink()
    if "costs" in name or "fault" in name:
        with pytest.raises(StoreError, match=rf"{name.rpartition('/')[2]} is missing; --resume"):
            compare_stores([tmp_path / "x"])
    results = run(tmp_path / "x", resume=True)
    assert any("batch 3 of the store was corrupted" in n for n in results.notices)
    same(tmp_path / "x", whole.folder)


def test_another_level_of_keeping_is_refused(whole):
    with pytest.raises(StoreError, match="keep was 'diagonal' and is 'full'"):
        run(whole.folder, resume=True, keep="full")


# Memory


class Greedy(EKF):
    """Takes all the memory it can get when it sees a batch of two."""

    def init(self, mean, cov):
        if len(mean) == 2:
            hoard = [np.ones(2**20)]
            size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            before = resource.getrlimit(resource.RLIMIT_AS)
            resource.setrlimit(resource.RLIMIT_AS, (size + 2**28, before[1]))
            try:
                while True:
                    hoard.append(np.ones(2**20))
            finally:
                hoard.clear()
                resource.setrlimit(resource.RLIMIT_AS, before)
        return super().init(mean, cov)


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs /proc")
@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_a_batch_that_finds_no_memory_is_named_and_the_rest_completes(tmp_path, executor):
    options = {"estimators": [f"{__name__}:Greedy"], "runs": 42, "executor": executor}
    results = run(tmp_path / "x", **options, workers=1)
    assert results.failed == 1
    assert len(results.runs) == done(tmp_path / "x") == 40
    (notice,) = [n for n in results.notices if "missing" in n]
    assert notice.startswith("runs 40-41 are missing: no memory, 3 times")


def starve(x):
    raise MemoryError


def test_where_nothing_fits_it_ends_soon():
    outcomes = list(execute(starve, range(2), executors.pool("threads", 2)))
    assert {o.task for o in outcomes} == {0, 1}  # type: ignore[union-attr]
    assert all("no memory" in str(o.error) for o in outcomes)  # type: ignore[union-attr]


def test_workers_are_as_many_as_the_memory_holds():
    gib = 2**30
    assert executors.fitting("threads", 3 * gib, cpus=64, memory=96 * gib) == 16
    assert executors.fitting("threads", 1, cpus=64, memory=96 * gib) == 64
    assert executors.fitting("processes", 1, cpus=64, memory=5 * gib) == 10
    assert executors.fitting("threads", gib, cpus=64, memory=0) == 1
    assert executors.fitting("threads", gib, cpus=3, memory=None) >= 1
    assert executors.fitting("both", 1, cpus=64, memory=5 * gib) == 10


# A cluster


def test_a_scheduler_that_does_not_answer_is_named_in_time(monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    monkeypatch.setattr(dask, "TIMEOUT", 1.0)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        began = time.monotonic()
        with pytest.raises(ExecutorError, match=f"no dask scheduler answers at {address}"):
            executors.pool("dask", 1, address)
        assert time.monotonic() - began < 15


def test_a_scheduler_without_workers_is_no_hang(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    monkeypatch.setattr(dask, "TIMEOUT", 1.0)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None) as local,
        pytest.raises(ExecutorError, match="no dask worker is known to the scheduler"),
    ):
        run(tmp_path / "x", executor="dask", address=local.scheduler_address)
    assert not (tmp_path / "x").exists()


def test_a_cluster_that_is_lost_leaves_what_was_finished(whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    import dask

    timeouts = {"distributed.comm.timeouts.connect": "1s", "distributed.comm.timeouts.tcp": "1s"}
    local = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    )
    with dask.config.set(timeouts):
        results = run(
            tmp_path / "x", executor="dask", address=local.scheduler_address,
            progress=lambda *_: local.close(),
        )  # fmt: skip
    assert results.failed > 0
    assert 0 < len(results.runs) < 40
    assert any("the cluster was lost; go on with --resume" in n for n in results.notices)
    run(tmp_path / "x", resume=True)
    same(tmp_path / "x", whole.folder)


def test_missing_runs_of_one_reason_are_one_line():
    batches = [range(i, i + 5) for i in range(0, 30, 5)]
    failed = {i: ExecutorError("a" if i < 4 else "b") for i in (0, 2, 3, 4)}
    lines = dispatch.missing(batches, failed)
    assert lines == [
        "runs 0-4 are missing: a", "runs 10-19 are missing: a", "runs 20-24 are missing: b"
    ]  # fmt: skip
