from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from estbench.montecarlo import executors
from estbench.montecarlo.pool import execute, keeping


def test_one_executor_works_off_all_tasks_of_a_block():
    made, ended = [], []
    threads = executors.pool("threads", 2)

    def make():
        made.append(ThreadPoolExecutor(1))
        return made[-1]

    using = replace(threads, make=make, abandon=ended.append)
    with keeping(using) as kept:
        assert dict(execute(abs, [-1, 2], kept)) == {-1: 1, 2: 2}
        assert dict(execute(abs, [-3], kept)) == {-3: 3}
        assert len(made) == 1
        assert not ended
        kept.abandon(made[0])  # it is lost, and replaced
        assert dict(execute(abs, [-4], kept)) == {-4: 4}
    assert ended == made
    assert len(made) == 2
    assert dict(execute(abs, [-5], using)) == {-5: 5}
    assert ended == made
    assert len(made) == 3
