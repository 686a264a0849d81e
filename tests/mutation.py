"""A sampled mutation run of some packages with cosmic-ray; docs/testing.md says how and why.

    python tests/mutation.py spaces estimators --count 40 --seed 0
    python tests/mutation.py sensors/clock sensors/timing simulation/truth --together --count 30

It changes modules in place, one at a time, and restores them: run it in a clean clone.
"""

import argparse
import ast
import importlib
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from difflib import unified_diff
from pathlib import Path

import pytest
from cosmic_ray.commands import init
from cosmic_ray.mutating import use_mutation
from cosmic_ray.plugins import get_operator
from cosmic_ray.work_db import WorkDB
from cosmic_ray.work_item import MutationSpec

SHARED = {
    "estimators": ["textbook", "gaussian_family", "large_rotations", "registry", "bad_input"],
    "inference": [],
    "randomness": [],
    "sensors/clock": [],
    "sensors/sampling": [],
    "sensors/suite": [],
    "sensors/timing": [],
    "simulation": [],
    "smoothers": ["estimators", "rts", "map", "large_rotations"],
}
"""Package or module -> tests that concern all its modules; elsewhere those of the package do."""
ALSO = {
    "estimators/linear": ["estimators/test_gaussian_family.py", "estimators/test_robust.py"],
    "estimators/settings": ["estimators/test_sr_ukf.py", "estimators/test_adaptive.py"],
    "estimators/over": ["estimators/test_biased.py", "smoothers/test_estimators.py"],
    "estimators/sigma_points": ["estimators/test_ckf.py", "estimators/test_ghkf.py"],
    "inference/event_loop": ["inference/test_offline.py", "inference/test_delays.py"],
    "inference/fusion": ["inference/test_delays.py", "inference/test_offline.py"],
    "inference/inbox": ["inference/test_fusion.py", "inference/test_delays.py"],
    "inference/innovations": ["inference/test_event_loop.py"],
    "inference/lags": ["inference/test_innovations.py"],
    "inference/latest": ["inference/test_live.py"],
    "inference/live": ["inference/test_latest.py"],
    "inference/run_subset": ["inference/test_fusion.py"],
    "inference/traces": ["inference/test_event_loop.py", "inference/test_innovations.py"],
    "sensors/clock": ["sensors/test_suite.py", "simulation/test_truth.py"],
    "sensors/sampling": ["sensors/test_suite.py", "sensors/test_timing.py"],
    "sensors/suite": ["sensors/test_sampling.py"],
    "sensors/timing": ["sensors/test_clock.py", "sensors/test_sampling.py"],
    "simulation/truth": ["sensors/test_schedule_times.py"],
    "spaces/linalg": ["estimators/test_textbook.py", "smoothers/test_rts.py"],
}
"""Module -> further tests than those of its own name."""
SLOW = {
    "inference": "quadrotor or ukf or sr_ekf or pf or enkf or imm or bias_ekf or ghkf or errs_more"
    " or overconfident or at_any_size or every_reading_is_fused_once",
}
"""Package -> tests that are left out here, as an expression of `pytest -k`."""
OPERATORS = re.compile(
    "core/(NumberReplacer|ReplaceAndWithOr|ReplaceOrWithAnd|ReplaceTrueWithFalse"
    "|ReplaceFalseWithTrue|AddNot|ZeroIterationForLoop|ReplaceBreakWithContinue"
    "|ReplaceUnaryOperator_Delete_(USub|Not|Invert)"
    "|ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Pow_Mul|FloorDiv_Mul|Mod_Add"
    "|BitAnd_BitOr|BitOr_BitAnd)"
    "|ReplaceComparisonOperator_(Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is"
    "|Lt_LtE|Lt_GtE|LtE_Lt|LtE_Gt|Gt_GtE|Gt_LtE|GtE_Gt|GtE_Lt))"
)
"""Operators in use: of each sign the one or two that code of this kind gets wrong."""
PRELOADED = ["hypothesis", "mujoco", "pydantic", "scipy.stats", "typer", "xarray", "zarr"]
"""What every test process would import again, none of it under test."""
TIMEOUT = 240.0  # s


def mutants(names: list[str]) -> list[MutationSpec]:
    """All mutants of packages and modules in a fixed order, without those of annotations."""
    found = [p for name in names for p in Path("estbench").glob(f"{name}.py")]
    found += [p for name in names for p in Path("estbench", name).glob("*.py")]
    modules = sorted(p for p in set(found) if p.name != "__init__.py")
    with tempfile.TemporaryDirectory() as folder:
        session = WorkDB(f"{folder}/session.sqlite", WorkDB.Mode.create)
        init(modules, session, {})
        found = [m for item in session.work_items for m in item.mutations]
        session.close()
    skipped = {path: list(annotations(Path(path))) for path in map(str, modules)}
    found = [
        m for m in found
        if OPERATORS.fullmatch(m.operator_name)
        and not any(a <= m.start_pos <= b for a, b in skipped[str(m.module_path)])
    ]  # fmt: skip
    return sorted(
        found, key=lambda m: (str(m.module_path), m.start_pos, m.operator_name, m.occurrence)
    )


def annotations(path: Path) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Where the annotations of a module begin and end, (line, column) both."""
    for node in ast.walk(ast.parse(path.read_text())):
        for name in ("annotation", "returns"):
            part = getattr(node, name, None)
            if isinstance(part, ast.expr):
                yield (
                    (part.lineno, part.col_offset),
                    (part.end_lineno or 0, part.end_col_offset or 0),
                )


def tests(path: Path) -> list[str]:
    """The test files that concern a module, its own first."""
    package, module = path.parent.name, path.stem
    folder = Path("tests", package)
    chosen = [folder / f"test_{module}.py"]
    chosen += [Path("tests", name) for name in ALSO.get(f"{package}/{module}", [])]
    shared = SHARED.get(f"{package}/{module}", SHARED.get(package))
    if shared is not None:
        chosen += [folder / f"test_{name}.py" for name in shared]
    else:
        chosen += sorted(folder.glob("test_*.py"))
    return [str(p) for p in dict.fromkeys(chosen) if p.exists()]


def outcome(files: list[str], package: str, limit: float = TIMEOUT) -> int:
    """Exit status of pytest on some files, in a fork; the packages are imported already.

    Args:
        files: of tests.
        package: that they test; its slow tests are left out.
        limit: s; tests that take longer count as failed.
    """
    chosen = [*files, "-k", f"not ({SLOW[package]})"] if package in SLOW else files
    child = os.fork()
    if not child:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        os._exit(int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *chosen])))
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return 1


def tested(mutant: MutationSpec) -> tuple[bool, str]:
    """Whether the tests find a mutant, and its difference."""
    operator = get_operator(mutant.operator_name)(**mutant.operator_args)
    with use_mutation(mutant.module_path, operator, mutant.occurrence) as (before, after):
        lines = (before.splitlines(), after.splitlines())
        change = unified_diff(*lines, str(mutant.module_path), "mutant", lineterm="", n=1)
        path = Path(mutant.module_path)
        return outcome(tests(path), path.parent.name) != 0, "\n".join(change)


def clean(drawn: list[MutationSpec]) -> bool:
    """Whether the tests of some mutants' modules pass without the mutants."""
    files: dict[str, list[str]] = {}
    for mutant in drawn:
        path = Path(mutant.module_path)
        files.setdefault(path.parent.name, []).extend(tests(path))
    return not any(
        outcome(list(dict.fromkeys(own)), package, 10 * TIMEOUT) for package, own in files.items()
    )


def main() -> None:
    """Draw, test and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="+", help="packages, or modules as package/module")
    parser.add_argument("--together", action="store_true", help="one sample for all names")
    parser.add_argument("--count", type=int, default=40, help="mutants of each sample")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sys.dont_write_bytecode = True
    for module in PRELOADED:
        importlib.import_module(module)
    for names in [options.names] if options.together else [[name] for name in options.names]:
        label, population = " ".join(names), mutants(names)
        drawn = random.Random(options.seed).sample(population, min(options.count, len(population)))
        if not clean(drawn):
            sys.exit(f"{label}: its tests fail on the unchanged modules; repair them first")
        killed = 0
        for number, mutant in enumerate(drawn, 1):
            found, change = tested(mutant)
            killed += found
            where = f"{mutant.module_path}:{mutant.start_pos[0]} {mutant.operator_name}"
            print(number, "killed" if found else "SURVIVED", where, flush=True)
            if not found:
                print(change, flush=True)
        print(f"{label}: {killed} of {len(drawn)} killed, of {len(population)}", flush=True)


if __name__ == "__main__":
    main()
