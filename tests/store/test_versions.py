"""A store that was begun under one version and gone on with under another says so."""

import json
import sys

import pytest

import estbench
from estbench.analysis import numbers
from estbench.analysis.compare import compare_stores
from estbench.commands import cli
from estbench.report import facts, sources, tables
from estbench.store import versions
from tests.stores import run

NOTE = "begun with mujoco 4.0.0, continued with 4.0.1: the numbers may not be those of an"


@pytest.fixture
def installed(monkeypatch):
    """A function that lets another version of a package be installed."""
    real, others = versions.version, {}
    monkeypatch.setattr(versions, "version", lambda name: others.get(name) or real(name))
    return others.update


def cut(folder, **options):
    """The first half of a store."""

    def interrupt(done, total):
        if done >= 20:
            raise KeyboardInterrupt

    return run(folder, progress=interrupt, workers=1, **options)


def test_a_store_of_two_versions_says_so_wherever_it_is_read(tmp_path, installed):
    installed({"mujoco": "4.0.0", "xarray": "1"})
    assert not cut(tmp_path / "x").notices
    installed({"mujoco": "4.0.1", "xarray": "2"})  # which package reads it changes no number
    said = []
    results = run(tmp_path / "x", resume=True, say=said.append)
    (note,) = results.notices
    assert note.startswith(NOTE)
    assert said == [note]
    with estbench.open_results(tmp_path / "x") as tree:
        (later,) = tree.attrs["continued"]
        both = tree.attrs["versions"], later
    assert [v["mujoco"] for v in both] == ["4.0.0", "4.0.1"]
    assert [v["xarray"] for v in both] == ["1", "2"]
    (source,) = {e.source for e in sources.load([tmp_path / "x"])}
    rows = dict(facts.facts(source).rows)
    assert "mujoco 4.0.0" in rows["versions"]
    assert "mujoco 4.0.1" in rows["continued with"]
    assert any(NOTE in line for line in tables.notices(sources.load([tmp_path / "x"]), [None]))
    (contest,) = numbers.to_dict(compare_stores([tmp_path / "x"]))["contests"]
    assert contest["folders"][0]["continued"] == [later]
    # Nothing is left to compute: a third version changes nothing, and is not written down.
    installed({"mujoco": "4.0.2"})
    again = run(tmp_path / "x", resume=True, say=lambda line: pytest.fail("it is whole"))
    assert again.notices == (note,)


def test_a_store_continued_with_the_compiled_loops_says_so(tmp_path, installed, monkeypatch):
    monkeypatch.setattr(versions, "find_spec", lambda name: None)
    cut(tmp_path / "x")
    monkeypatch.setattr(versions, "find_spec", lambda name: True)
    installed({"numba": "0.62"})
    (note,) = run(tmp_path / "x", resume=True).notices
    assert note.startswith(
        "begun with the extra fast (numba) absent, continued with 0.62: the numbers may not be"
    )


def test_one_version_says_nothing(tmp_path):
    cut(tmp_path / "x")
    results = run(tmp_path / "x", resume=True, say=lambda line: pytest.fail(line))
    assert not results.notices
    with estbench.open_results(tmp_path / "x") as tree:
        assert "continued" not in tree.attrs


def test_every_package_and_every_version_is_named():
    first = {"mujoco": "4.0.0", "numpy": "2.1.0", "xarray": "1"}
    known = versions.known(
        {"versions": first, "continued": [first | {"numpy": "2.2.0"}, first | {"numpy": "2.3.0"}]}
    )
    said = versions.mixed(known)
    assert said is not None
    assert said.startswith("begun with numpy 2.1.0, continued with 2.2.0, 2.3.0: the numbers")
    also = versions.mixed([*known, first | {"mujoco": "4.1.0"}])
    assert also is not None
    assert also.startswith("begun with mujoco 4.0.0, continued with 4.1.0; begun with numpy 2.1.0,")
    assert versions.mixed([first, first | {"xarray": "2"}]) is None
    assert versions.mixed(versions.known({})) is None  # of a store that kept none


def test_the_command_line_says_it_on_stderr(tmp_path, installed, capfd, monkeypatch):
    installed({"mujoco": "4.0.0"})
    folder = tmp_path / "x"
    cut(folder)
    installed({"mujoco": "4.0.1"})
    command = f"estbench run {folder} --out {folder} --resume --executor threads --json"
    monkeypatch.setattr(sys, "argv", command.split())
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out, err = capfd.readouterr()
    assert not ended.value.code
    assert [line for line in err.splitlines() if "runs, " not in line] == [
        f"note: {json.loads(out)['notices'][0]}"
    ]
    assert NOTE in err
