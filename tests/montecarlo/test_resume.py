"""Nothing finished is ever lost: resume, shards, corruption, dead workers, a cluster."""

import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import estbench
from estbench.errors import ExecutorError, StoreError
from estbench.experiment import setup
from estbench.montecarlo import dask, executors
from estbench.montecarlo.pool import Failed, execute
from estbench.store.metadata import STORE
from estbench.store.zarr import Store
from tests.stores import run, same


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "x"
    return run(out)


def begin(tmp_path, *extra):
    """A run in a process of its own."""
    command = [
        sys.executable, "-m", "estbench", "run", "pendulum", "-e", "ekf", "--runs", "400",
        "--duration", "1", "--out", str(tmp_path / "x"), "--workers", "1", *extra,
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finished(folder: Path) -> int:
    try:
        with estbench.open_results(folder) as tree:
            return int(tree["done"].sum())
    except StoreError:
        return 0


def test_kill_9_and_resume_gives_the_uninterrupted_store(tmp_path):
    process = begin(tmp_path)
    deadline = time.monotonic() + 60
    while not finished(tmp_path / "x") and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = finished(tmp_path / "x")
    assert done > 0
    computed = []
    options = {"estimators": ["ekf"], "runs": 400, "duration": 1.0}
    results = estbench.run(
        "pendulum", **options, out=tmp_path / "x", resume=True,
        progress=lambda n, total: computed.append((n, total)),
    )  # fmt: skip
    assert len(results.runs) == 400
    if done < 400:
        assert computed[-1] == (400 - done, 400 - done)
    estbench.run("pendulum", **options, out=tmp_path / "y")
    same(tmp_path / "x", tmp_path / "y")


def test_resume_computes_only_what_is_missing(whole, tmp_path):
    def interrupt(done, total):
        if done >= 15:
            raise KeyboardInterrupt

    cut = run(tmp_path / "x", progress=interrupt, workers=1)
    assert cut.interrupted
    assert 15 <= len(cut.runs) < 40
    seen = []
    rest = run(tmp_path / "x", resume=True, progress=lambda done, total: seen.append(total))
    assert set(seen) == {40 - len(cut.runs)}
    assert rest["ekf"].anees == whole["ekf"].anees
    assert rest["ekf"].cost > 0
    same(tmp_path / "x", whole.folder)
    again = run(tmp_path / "x", resume=True, progress=lambda *_: pytest.fail("nothing is missing"))
    assert str(again["ekf"].rmse) == str(whole["ekf"].rmse)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"seed": 1}, r"simulation\.seed was .* and is"),
        ({"duration": 0.2}, r"simulation\.duration was .* and is"),
        ({"runs": 39}, "has 40 runs and 39 are asked for: runs are added"),
    ],
)
def test_a_store_of_another_scenario_is_refused(whole, options, said):
    with pytest.raises(StoreError, match=said):
        run(whole.folder, resume=True, **options)


@pytest.mark.parametrize(
    "name", ["ekf/anees/c/3", "ekf/error/c/3/0/0", "truth/x/c/3/0/0", "done/c/3"]
)
def test_a_corrupted_chunk_is_computed_again_and_said(whole, tmp_path, name):
    shutil.copytree(whole.folder, tmp_path / "x")
    chunk = tmp_path / "x" / STORE / name
    content = bytearray(chunk.read_bytes())
    content[1] ^= 0xFF
    chunk.write_bytes(content)
    totals = []
    results = run(tmp_path / "x", resume=True, progress=lambda done, total: totals.append(total))
    assert totals == [5]
    if not name.startswith("done"):
        assert any("batch 3 of the store was corrupted" in n for n in results.notices)
    same(tmp_path / "x", whole.folder)


def test_a_store_deleted_while_running_is_said(tmp_path):
    def delete(done, total):
        shutil.rmtree(tmp_path / "x" / STORE, ignore_errors=True)

    with pytest.raises(StoreError, match="cannot be written") as caught:
        run(tmp_path / "x", progress=delete, workers=1)
    assert "\n" not in str(caught.value)


def test_two_shards_in_two_threads_fill_one_store(whole, tmp_path):
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(lambda i: run(tmp_path / "x", shard=(i, 2)), (1, 2)))
    assert max(len(p.runs) for p in parts) >= 20
    assert len(run(tmp_path / "x", resume=True).runs) == 40
    same(tmp_path / "x", whole.folder)


def test_two_processes_cannot_write_one_store(whole):
    prepared = setup.build(whole.scenario)
    with (
        Store.reopen(whole.folder, prepared).lock(),
        pytest.raises(StoreError, match="another process is writing"),
    ):
        run(whole.folder, resume=True)


@pytest.mark.parametrize("shard", [(5, 4), (0, 2), (1, 0)])
def test_a_shard_that_is_none(tmp_path, shard):
    with pytest.raises(ExecutorError, match="shard is"):
        run(tmp_path / "x", shard=shard)
    assert not (tmp_path / "x").exists()


def test_processes_give_the_same_store(whole, tmp_path):
    run(tmp_path / "x", executor="processes", workers=2)
    same(tmp_path / "x", whole.folder)


def double(x):
    return 2 * x


def die_on_three(x):
    if x == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * x


def die_once(marker):
    path = Path(marker)
    if path.name == "once" and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def test_a_task_that_kills_its_worker_is_found_out_and_the_rest_completes():
    outcomes = list(execute(die_on_three, range(6), executors.pool("processes", 2)))
    failed = [o for o in outcomes if isinstance(o, Failed)]
    assert [f.task for f in failed] == [3]
    assert "the worker died 3 times" in str(failed[0].error)
    good = dict(o for o in outcomes if not isinstance(o, Failed))
    assert good == {i: 2 * i for i in (0, 1, 2, 4, 5)}


def test_a_worker_that_dies_once_is_replaced(tmp_path):
    tasks = [str(tmp_path / name) for name in ("a", "once", "b")]
    outcomes = dict(execute(die_once, tasks, executors.pool("processes", 2)))
    assert sorted(outcomes.values()) == ["a", "b", "once"]


def test_a_task_that_raises_does_not_stop_the_others():
    def fail_on_two(x):
        if x == 2:
            raise ValueError("two")
        return x

    outcomes = list(execute(fail_on_two, range(4), executors.pool("threads", 2)))
    failed = [o for o in outcomes if isinstance(o, Failed)]
    assert [(f.task, str(f.error)) for f in failed] == [(2, "two")]
    assert len(outcomes) == 4


def test_an_unknown_executor_and_a_missing_address():
    with pytest.raises(ExecutorError, match="executor is 'slurm'"):
        executors.pool("slurm", 1)
    with pytest.raises(ExecutorError, match="address"):
        executors.pool("dask", 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resume": True}, "resume needs the folder that it fills"),
        ({"shard": (1, 2)}, "shard needs the folder that it fills"),
        ({"address": "tcp://127.0.0.1:9"}, "address is .*, but executor is 'threads'"),
    ],
)
def test_options_that_would_have_no_effect_are_refused(options, message):
    with pytest.raises((StoreError, ExecutorError), match=message):
        estbench.run("pendulum", "ekf", runs=2, duration=0.1, **options)


def test_an_unreachable_scheduler_is_named_in_time(monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    assert dask.TIMEOUT <= 10.0  # importing the library takes its time too
    monkeypatch.setattr(dask, "TIMEOUT", 1.0)
    began = time.monotonic()
    with pytest.raises(ExecutorError, match=r"tcp://127\.0\.0\.1:9"):
        executors.pool("dask", 1, "tcp://127.0.0.1:9")
    assert time.monotonic() - began < 15


def test_a_dask_cluster_with_a_killed_worker_gives_the_same_store(whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:
        killed = []

        def kill_one(done, total):
            if not killed:
                nanny = next(iter(local.workers.values()))
                killed.append(nanny.pid)
                os.kill(nanny.pid, signal.SIGKILL)

        results = run(
            tmp_path / "x", executor="dask", address=local.scheduler_address, progress=kill_one
        )
    assert killed
    assert len(results.runs) == 40
    same(tmp_path / "x", whole.folder)
