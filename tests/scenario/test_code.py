"""Code that a scenario of somebody else names is not run unless the user says so."""

import pytest

import estbench
from estbench.analysis.load import load as load_store
from estbench.errors import TRUST, ScenarioError
from estbench.scenario import code
from estbench.scenario.load import load
from estbench.store.metadata import STORE

EVIL = "from pathlib import Path\nPath({marker!r}).touch()\npush = lambda t, x: 0 * x[:, :1]\n"
CONTROL = 'control = {kind = "user", function = "evil_for_test:push"}\n'


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """A scenario in a folder of somebody else, and whether its code was run."""
    folder, here = tmp_path / "foreign", tmp_path / "here"
    folder.mkdir()
    here.mkdir()
    marker = tmp_path / "ran"
    (folder / "evil_for_test.py").write_text(EVIL.format(marker=str(marker)))
    (folder / "scenario.toml").write_text(
        'name = "theirs"\nmodel = {path = "estbench:assets/pendulum/pendulum.xml"}\n'
        "simulation = {runs = 2, duration = 0.05}\nestimators = {ekf = {}}\n" + CONTROL
    )
    monkeypatch.delenv(TRUST, raising=False)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(here)
    return folder, marker


def test_it_is_asked_for_and_nothing_is_run(foreign, monkeypatch):
    folder, marker = foreign
    path = folder / "scenario.toml"
    asked = (
        r"scenario\.toml names code that would be run: control\.function = evil_for_test:push; "
        rf"read it, then allow it by --trust or {TRUST}=1"
    )
    for use in (load, estbench.run):
        with pytest.raises(ScenarioError, match=asked):
            use(path)
    # What an option replaces is the user's own word.
    assert load(path, ["control.kind=none", "control.function=numpy:sin"])
    assert not marker.exists()
    monkeypatch.setenv(TRUST, "1")
    folder_of_results = folder / "results"
    assert len(estbench.run(path, out=folder_of_results).runs) == 2
    assert marker.exists()
    assert load_store(folder_of_results).total == 2
    monkeypatch.setenv(TRUST, "0")
    assert (folder_of_results / STORE).is_dir()
    with pytest.raises(ScenarioError, match=r"results/scenario\.toml names code"):
        load_store(folder_of_results)


def test_code_of_the_current_folder_and_a_scenario_in_it_need_no_word(foreign, monkeypatch):
    folder, _ = foreign
    monkeypatch.chdir(folder.parent)
    assert load(folder / "scenario.toml").control.function == "evil_for_test:push"


def test_all_that_names_code_is_listed():
    data = {
        "model": {"path": "their_package:robot.xml"},
        "control": {"function": "a:u", "estimator": {"type": "b:Filter"}},
        "process_noise": {"schedule": "c:q"},
        "channels": {"x": {"function": "d:h", "unit": "m:s"}},
        "estimators": {"imm": {"models": [{"type": "e.f:Filter"}]}, "ekf": {"type": "ekf"}},
        "filter": {"path": "estbench:assets/x.xml", "channels": {"x": {"schedule": [[1, 2]]}}},
    }
    assert dict(code.named(data)) == {
        "control.function": "a:u", "control.estimator.type": "b:Filter",
        "process_noise.schedule": "c:q",
        "channels.x.function": "d:h", "estimators.imm.models.0.type": "e.f:Filter",
    }  # fmt: skip
    (line,) = code.listed({"control": {"function": "json:dumps"}})
    assert line.startswith("control.function = json:dumps (/")
