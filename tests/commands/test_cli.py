import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import estbench
from estbench.commands import cli, run
from estbench.errors import EstimatorError
from estbench.estimators.ekf import EKF
from estbench.scenario.files import bundled

SCRIPT = Path(sys.executable).with_name("estbench")
SHORT = ("--runs", "4", "--duration", "0.1")
HERE = "tests.commands.test_cli"

ROBOT = """
<mujoco><option timestep="0.01"/><worldbody><body><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="0.3"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator>
<sensor><jointpos name="encoder" joint="hinge" noise="0.01"/></sensor></mujoco>"""
FILES = {
    "robot.xml": ROBOT,
    "blind.xml": ROBOT.replace('<jointpos name="encoder" joint="hinge" noise="0.01"/>', ""),
    "unclosed.xml": ROBOT.replace("</mujoco>", ""),
    "massless.xml": ROBOT.replace('mass="0.3"', 'mass="0"'),
    "dangling.xml": ROBOT.replace('name="encoder" joint="hinge"', 'name="encoder" joint="hing"'),
    "unmoved.xml": ROBOT.replace('<motor name="motor" joint="hinge"/>', '<motor joint="nail"/>'),
    "still.xml": ROBOT.replace('<joint name="hinge" axis="0 1 0"/>', ""),
    "torn.toml": 'name = "a"\n[model\npath = 3',
    "empty.toml": "",
    "wrong.toml": "name = 'a'\n[model]\npath = 'robot.xml'\nframeskip = 2\n[simulation]\nrun = 3\n"
    "duration = 'long'\n[channels.encoder]\nnois = 1\n[extra]\n",
    "u.csv": "0,1,2\n",
    "filter_here.py": "",
    "taken/notes.txt": "dear",
}


def raises(t, x):
    if t > 0.05:
        raise RuntimeError("two\nlines")
    return 0.0


def not_finite(t, x):
    return np.full((len(x), 1), np.nan if t > 0.05 else 0.0)


class Gained(EKF):
    """An EKF with a setting."""

    def __init__(self, model, gain_scale=1.0):
        super().__init__(model)
        if gain_scale != 1.0:
            raise EstimatorError(f"gain_scale is {gain_scale}")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.fixture
def call(folder, monkeypatch, capfd):
    """The command line in this process: exit code, standard output and error."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["estbench", *arguments])
        with pytest.raises(SystemExit) as exit_:
            cli.main()
        out, err = capfd.readouterr()
        return exit_.value.code or 0, out, said(err)

    return run


def said(err):
    """Standard error without the progress that a slow machine shows."""
    return re.sub(r"^\d+ of \d+ runs, .+ s\n", "", err, flags=re.MULTILINE)


def contents(folder):
    return {str(p.relative_to(folder)): p.is_file() and p.read_bytes() for p in folder.rglob("*")}


# What works


def test_run_prints_tables_and_writes_a_folder(call, folder):
    code, out, err = call("run", "cartpole", "-e", "ekf", "--estimator", "ukf", *SHORT)
    assert code == 0
    # On a busy machine the run may take the two seconds after which progress is shown.
    assert [line for line in err.splitlines() if not line.startswith("4 of 4 runs, ")] == []
    assert out.startswith("cartpole: 4 runs x 0.1 s (10 steps), seed 0\n")
    for word in ("ekf", "ukf", "consistent", "NEES/n", "NIS/m", "pole.vel", "rad/s", "RMSE"):
        assert word in out
    (written,) = (folder / "results").iterdir()
    assert f"written to results/{written.name}" in out
    assert max(len(line) for line in out.splitlines()) <= 100
    with estbench.open_results(written) as tree:
        assert tree["done"].to_numpy().all()


def test_run_as_json_says_what_python_gets(call):
    arguments = ("--seed", "3", "--keep", "summary", "--workers", "1", "--out", "here", "--json")
    code, out, err = call("run", "cartpole", *SHORT, *arguments)
    assert (code, err) == (0, "")
    data = json.loads(out)
    results = estbench.run("cartpole", runs=4, duration=0.1, seed=3)
    expected = results.to_dict() | {"folder": "here"}
    for each in (*data["estimators"].values(), *expected["estimators"].values()):
        each.pop("cost_us_per_run_step")
    assert data == expected
    assert data["estimators"]["ekf"]["rmse"]["pole.vel"]["unit"] == "rad/s"
    assert (data["seed"], data["runs"], data["interrupted"]) == (3, 4, False)


def test_numbers_that_are_not_finite_are_null_in_json(call):
    _, out, _ = call("run", "cartpole", "-e", "ekf", "--runs", "1", "--duration", "0.1", "--json")
    ekf = json.loads(out)["estimators"]["ekf"]
    assert ekf["verdict"] == "undecided"
    assert ekf["anees_over_n"]["low"] is None


def test_run_again_from_a_results_folder(call):
    rest = ("-e", "ekf", *SHORT, "--set", "filter.process_noise_scale=0.5")
    _, first, _ = call("run", "pendulum", *rest, "--out", "a", "--json")
    code, second, _ = call("run", "a", "--out", "b", "--json")
    assert code == 0
    a, b = json.loads(first), json.loads(second)
    for data in (a, b):
        data["estimators"]["ekf"].pop("cost_us_per_run_step")
        data.pop("folder")
    assert a == b


def test_a_bare_mjcf_runs_and_says_what_it_assumed(call):
    code, out, err = call("run", "robot.xml", *SHORT)
    assert (code, err) == (0, "")
    assert "robot: 4 runs" in out
    assert "note: " in out


def test_list(call):
    code, out, err = call("list")
    assert (code, err) == (0, "")
    assert all(name in out for name in (*bundled(), "ekf", "ukf", "lqr", "jointpos"))
    code, out, err = call("list", "--json")
    assert (code, err) == (0, "")
    data = json.loads(out)
    assert set(data) == {"scenarios", "estimators", "controllers", "sensor types"}
    assert set(data["scenarios"]) == set(bundled())
    assert all(data["scenarios"].values())
    assert all(data["estimators"].values())


@pytest.mark.parametrize("name", sorted(bundled()))
def test_check_of_the_bundled_scenarios(name, call, folder):
    before = contents(folder)
    code, out, err = call("check", name)
    assert (code, err) == (0, "")
    assert out.startswith(f"{name}: ")
    unseen = "warning: no sensor can see root.x, root.y " if "periodic" in out else None
    assert "warning" not in (out if unseen is None else out.replace(unseen, ""))
    assert contents(folder) == before


def test_check_shows_states_sensors_and_rates(call):
    settings = ("--set", "channels.pole_encoder.rate=25", "--set", "initial.std=0.25")
    code, out, _ = call("check", "cartpole", *settings)
    assert code == 0
    lines = {line.split()[1]: line for line in out.splitlines() if line.startswith("│")}
    assert "25 Hz" in lines["pole_encoder"]
    assert "100 Hz" in lines["cart_encoder"]
    assert "0.01 rad²/s³" in lines["pole.vel"]
    assert "0.25" in lines["pole"]


def test_check_warns_of_what_no_sensor_sees(call):
    code, out, _ = call("check", "cartpole", "--set", 'sensors=["gyro"]')
    assert code == 0
    assert "warning: no sensor can see cart" in out.replace("\n", " ")


@pytest.mark.parametrize("arguments", [(), ("run",), ("list",), ("check",)])
def test_help(arguments, call):
    code, out, err = call(*arguments, "--help")
    assert (code, err) == (0, "")
    assert "Usage: " in out


def test_version(call):
    assert call("--version") == (0, f"estbench {estbench.__version__}\n", "")


def test_view_says_which_port_it_takes(call):
    _, out, _ = call("view", "--help")
    assert "0 takes the first free from 8080" in " ".join(out.replace("│", " ").split())


@pytest.mark.parametrize(("asked", "note"), [("0.015", True), ("0.02", False)])
def test_a_duration_that_is_rounded_is_said(asked, note, call):
    code, out, _ = call("run", "cartpole", "-e", "ekf", "--runs", "2", "--duration", asked)
    assert code == 0
    said = (
        "note: a duration of 0.015 s was asked for, 0.02 s are run: whole control periods of 0.01"
    )
    assert (said in " ".join(out.split())) == note


def test_no_command_shows_the_help(call):
    _, out, err = call()
    assert "Usage: estbench" in out
    assert err == ""


def test_ctrl_c_in_the_middle(folder, monkeypatch, capfd):
    def stop(done, total):
        raise KeyboardInterrupt

    class Progress:
        def __init__(self, total, ends):
            pass

        def __enter__(self):
            return stop

        def __exit__(self, *details):
            pass

    monkeypatch.setattr(run, "progress", Progress)
    arguments = ["run", "cartpole", "-e", "ekf", "--runs", "60", "--duration", "0.1", "--out", "x"]
    monkeypatch.setattr(sys, "argv", ["estbench", *arguments])
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    assert exit_.value.code == 130
    out, err = capfd.readouterr()
    found = re.search(r"interrupted: (\d+) of 60 runs finished", out)
    assert found
    assert said(err) == ""
    assert out.endswith("written to x\ngo on with --out x --resume\n")
    with estbench.open_results("x") as tree:
        # One batch was reported; others may have been written meanwhile, and then they count.
        assert 15 <= int(tree["done"].sum()) == int(found[1]) < 60


def test_runs_that_are_missing_are_named_and_change_the_exit_code(call):
    # finds no memory for the last batch, which has two runs
    greedy = "tests.montecarlo.test_faults:Greedy"
    code, out, _ = call("run", "pendulum", "-e", greedy, "--runs", "32", "--duration", "0.1",
                        "--out", "x")  # fmt: skip
    assert code == 1
    assert "note: runs 30-31 are missing: no memory, 3 times" in out
    with estbench.open_results("x") as tree:
        assert int(tree["done"].sum()) == 30


# What does not: one line that says what, exit code 2, nothing left behind

USER = ("run", "cartpole", *SHORT, "--set", "control.kind=user", "--set")
BAD = {
    "scenario": (("run", "cartpol"), "no scenario 'cartpol' .did you mean 'cartpole'"),
    "file": (("run", "nowhere.toml"), "no file 'nowhere.toml'"),
    "other file": (("run", "u.csv"), "neither .toml nor .xml"),
    "folder": (("run", "taken"), "no scenario 'taken'"),
    "estimator": (("run", "cartpole", "-e", "ekff"), "no estimator 'ekff' .did you mean 'ekf'"),
    "estimator module": (("run", "cartpole", "-e", "no.such:X"), "cannot import 'no.such'"),
    "estimator's file": (
        ("run", "cartpole", "-e", "./filter_here.py:Mine"),
        r"'./filter_here.py' is a file; name its module, 'filter_here'$",
    ),
    "estimator's file elsewhere": (
        ("run", "cartpole", "-e", f"{__file__}:Mine"),
        "name its module, 'test_cli', with its folder in PYTHONPATH: '",
    ),
    "suffix": (("run", "still"), r"no scenario 'still' \(did you mean 'still.xml'\?\)$"),
    "sensors of none": (
        ("run", "blind.xml", "--set", 'sensors=["gyr"]'),
        "sensors: no sensor 'gyr'; the MJCF declares none: add <sensor> elements",
    ),
    "estimator after the colon": (
        ("run", "cartpole", "-e", "mine:"),
        "estimator 'mine:': the name after the colon is missing",
    ),
    "setting of another": (
        ("run", "cartpole", "-e", "ekf", "--set", "estimators.ukf.alpa=3"),
        "'estimators.ukf.alpa=3' has no effect: 'ukf' is not run; .* that run are ekf$",
    ),
    "setting of none": (
        ("run", "cartpole", "-e", "ekf", "-e", "kf", "--set", 'estimators."no.such".alpha=3'),
        "'no.such' is not run; the estimators that run are ekf, kf$",
    ),
    "setting of a class": (
        ("run", "cartpole", "-e", f"{HERE}:Gained", "--set", "estimators.Gained.gain_scal=0.7"),
        "Gained: no setting 'gain_scal' .did you mean 'gain_scale'",
    ),
    "type of a class": (
        ("run", "cartpole", "-e", f"{HERE}:Gained", "--set", "estimators.Gained.type=ekf"),
        f"'{HERE}:Gained': the label 'Gained' is that of the scenario's 'ekf'",
    ),
    "value for a class": (
        ("run", "cartpole", "-e", f"{HERE}:Gained", "--set", "estimators.Gained.gain_scale=0.7"),
        "gain_scale is 0.7",
    ),
    "estimator type": (
        ("run", "cartpole", "--set", "estimators={a={type='ufk'}}"),
        "no estimator 'ufk' .did you mean 'ukf'",
    ),
    "estimator setting": (
        ("run", "cartpole", "--set", "estimators.ukf.alfa=1"),
        "ukf: no setting 'alfa' .did you mean 'alpha'",
    ),
    "estimator value": (("run", "cartpole", "--set", "estimators.ukf.alpha=-1"), "alpha is -1"),
    "label": (("run", "cartpole", "--set", "estimators={time={type='ekf'}}"), "label 'time'"),
    "torn toml": (("run", "torn.toml"), "torn.toml is not valid TOML: .*line 2"),
    "empty toml": (("run", "empty.toml"), "name: Field required; model: Field required"),
    "toml keys": (
        ("run", "wrong.toml"),
        "wrong.toml: model.frameskip: unknown key .did you mean 'frame_skip'.*; "
        "simulation.duration: .*got 'long'; simulation.run: unknown key .did you mean 'runs'.*; "
        "channels.encoder.nois: unknown key .did you mean 'noise'.*; extra: unknown key",
    ),
    "set": (("run", "cartpole", "--set", "simulation.runs"), "--set 'simulation.runs' is not of"),
    "mjcf gone": (("run", "cartpole", "--set", "model.path=gone.xml"), "no file .*gone.xml"),
    "mjcf unclosed": (("run", "unclosed.xml"), "unclosed.xml is not a valid MJCF: XML"),
    "mjcf massless": (("run", "massless.xml"), "MJCF does not compile: .*mass and inertia"),
    "mjcf sensor": (("run", "dangling.xml"), "does not compile: .*unrecognized name 'hing'"),
    "mjcf actuator": (("run", "unmoved.xml"), "does not compile: .*unknown .*'nail'"),
    "mjcf state": (("run", "still.xml", "--set", "sensors=[]"), "sens|no joint|does not compile"),
    "keyframe": (
        ("run", "cartpole", "--set", "model.keyframe=uprihgt"),
        "no keyframe 'uprihgt' .did you mean 'upright'",
    ),
    "parameter": (
        ("run", "cartpole", "--set", 'truth.set."body_mass.poel"=1.0'),
        "no body 'poel' .did you mean 'pole'",
    ),
    "R": (
        ("run", "cartpole", "--set", "channels.pole_encoder.noise=0"),
        r"channels.pole_encoder.noise is 0; R must be positive definite",
    ),
    "R matrix": (
        ("run", "cartpole", "--set", "channels.pole_encoder.cov=[[-1.0]]"),
        r"channels.pole_encoder.cov \(R\) is not symmetric positive definite",
    ),
    "P0": (("run", "cartpole", "--set", "initial.std=-1"), "initial.std is -1 for cart; use a"),
    "P0 matrix": (
        ("run", "pendulum", "--set", "initial.cov=[[1.0, 2.0], [2.0, 1.0]]"),
        r"initial.cov \(P₀\) is not symmetric positive semidefinite",
    ),
    "Q": (
        ("run", "pendulum", "--set", 'process_noise.density."hinge.vel"=-1'),
        "process_noise.density is negative for hinge.vel: -1",
    ),
    "Q matrix": (
        ("run", "pendulum", "--set", "process_noise.matrix=[[1.0, 2.0], [2.0, 1.0]]"),
        "process_noise.matrix is not symmetric positive semidefinite",
    ),
    "size of R": (
        ("run", "cartpole", "--set", "channels.pole_encoder.noise=[0.1, 0.1]"),
        "pole_encoder.noise has 2 values; expected 1",
    ),
    "size of P0": (
        ("run", "cartpole", "--set", "initial.cov=[[1.0]]"),
        r"initial.cov has shape \(1, 1\); expected \(4, 4\)",
    ),
    "size of std": (("run", "cartpole", "--set", "initial.std=[1, 1]"), "std has 2 values; expec"),
    "size of qpos": (("run", "cartpole", "--set", "initial.qpos=[0]"), "qpos has 1 values; expec"),
    "size of Q": (
        ("run", "cartpole", "--set", "process_noise.density=[1, 1, 1]"),
        "density has 3 values; expected 1 or 4",
    ),
    "size of filter": (
        ("run", "cartpole", "--set", "filter.path=robot.xml"),
        "filter.path: states hinge, hinge.vel",
    ),
    "size of control": (
        ("run", "robot.xml", "--set", "control={kind='csv', path='u.csv'}"),
        "u.csv', row 1 has 3 columns; expected 2",
    ),
    "blind": (
        ("run", "blind.xml", "--set", "sensors=[]"),
        "no sensor: the MJCF declares none in use; add",
    ),
    "no sensor": (("run", "cartpole", "--set", "sensors=[]"), "no sensor: "),
    "sensor": (
        ("run", "cartpole", "--set", 'sensors=["pole_encode"]'),
        "sensors: no sensor 'pole_encode' .did you mean 'pole_encoder'",
    ),
    "rate": (
        ("run", "cartpole", "--set", "channels.pole_encoder.rate=60"),
        r"channels.pole_encoder.rate is 60 Hz, .* steps of 0.01 s; .* use 50 or 100 Hz",
    ),
    "filter timestep": (("run", "cartpole", "--set", "filter.timestep=0.004"), "not a multiple of"),
    "out exists": (("run", "cartpole", *SHORT, "--out", "taken"), "taken exists; choose another"),
    "out is a file": (("run", "cartpole", *SHORT, "--out", "u.csv"), "u.csv exists; choose"),
    "out under a file": (
        ("run", "cartpole", *SHORT, "--out", "u.csv/a/b"),
        "u.csv/a/b cannot be written: Not a directory; choose another --out",
    ),
    "controller raises": (
        (*USER, f"control.function={HERE}:raises"),
        "raises' raised at t = 0.06 s: RuntimeError: two lines",
    ),
    "controller not finite": (
        (*USER, f"control.function={HERE}:not_finite", "--out", "deep/down"),
        r"not_finite' returned a value that is not finite at t = 0.06 s",
    ),
    "controller": ((*USER, f"control.function={HERE}:none"), "has no function 'none'"),
    "control": (("run", "cartpole", "--set", "control.kind=pid"), "control.kind: .*got 'pid'"),
    "runs 0": (("run", "cartpole", "--runs", "0"), "estbench: --runs: .*greater.* got 0"),
    "runs -1": (("run", "cartpole", "--runs", "-1"), "estbench: --runs: .*greater.* got -1"),
    "duration": (("run", "cartpole", "--duration", "-1"), "estbench: --duration: .*got -1"),
    "duration 0": (("run", "cartpole", "--duration", "0"), "estbench: --duration: .*got 0"),
    "duration nan": (("run", "cartpole", "--duration", "nan"), "estbench: --duration: .*finite"),
    "seed": (("run", "cartpole", "--seed", "-1"), "estbench: --seed: .*got -1"),
    "burn in": (("run", "cartpole", "--set", "consistency.burn_in=5"), "burn_in is 5 s, which"),
    "shard": (("run", "cartpole", "--shard", "5/4"), r"shard is 5/4; use i/n with 1 <= i <= n"),
    "shard in words": (("run", "cartpole", "--shard", "one"), "--shard is 'one'; use I/N"),
    "resume nowhere": (("run", "cartpole", "--resume", "--out", "taken"), "holds no data.zarr"),
    "resume without out": (("run", "cartpole", "--resume"), "resume needs the folder .* --out$"),
    "shard without out": (("run", "cartpole", "--shard", "1/2"), "shard needs the folder .*--out$"),
    "address": (
        ("run", "cartpole", "--address", "tcp://127.0.0.1:9"),
        "address is 'tcp://127.0.0.1:9', .* executor is 'auto'; add --executor dask",
    ),
    "robot": (
        ("reproduce", "--robot", "pendulum", "--robot", "nothing", "--runs", "2"),
        "no scenario 'nothing'",
    ),
    "dask": (("run", "cartpole", "--executor", "dask"), "needs the scheduler's address"),
    # the words of typer
    "runs x": (("run", "cartpole", "--runs", "x"), "Invalid value for '--runs'.* see estbench run"),
    "no number": (("run", "cartpole", "--runs"), "--runs.* requires an argument"),
    "workers": (("run", "cartpole", "--workers", "0"), "Invalid value for '--workers'"),
    "keep": (("run", "cartpole", "--keep", "all"), "Invalid value for '--keep'.*'summary'"),
    "no argument": (("run",), "Missing argument .*; see estbench run --help"),
    "too many": (("run", "cartpole", "pendulum"), "unexpected extra argument"),
    "option": (("run", "cartpole", "--rnus", "3"), "No such option: --rnus"),
    "command": (("rum", "cartpole"), "No such command 'rum'"),
}  # fmt: skip


def assert_refused(code, out, err, message):
    assert code == 2
    assert out == ""
    assert err.startswith("estbench: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert "Traceback" not in err
    assert re.search(message, err), err


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, call, folder):
    arguments, message = BAD[name]
    before = contents(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        code, out, err = call(*arguments)
    assert_refused(code, out, err, message)
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["scenario", "toml keys", "R", "mjcf sensor", "rate", "sensor"])
def test_check_refuses_what_run_refuses(name, call):
    arguments, message = BAD[name]
    assert_refused(*call("check", *arguments[1:]), message)


# The installed command


def start(*arguments, **options):
    return subprocess.Popen(
        [SCRIPT, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def test_a_module_of_the_current_folder(folder):
    (folder / "mine.py").write_text(
        "def push(t, x):\n    return -x[:, :1]\n"
        "from estbench.estimators.ekf import EKF\n\nclass Mine(EKF):\n    pass\n"
    )
    arguments = ("-e", "mine:Mine", "--set", "control.kind=user", "--set")
    process = start("run", "cartpole", *SHORT, *arguments, "control.function=mine:push", "--json")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, said(err)) == (0, "")
    assert list(json.loads(out)["estimators"]) == ["Mine"]


def test_without_asserts(folder):
    """`python -O`: zarr 3.1 needs one of its own."""
    arguments = ["-m", "estbench", "run", "pendulum", "-e", "ekf", "--runs", "2"]
    command = [sys.executable, "-O", *arguments, "--duration", "0.05", "--out", "x"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "consistent" in done.stdout or "undecided" in done.stdout


def test_a_name_that_the_locale_cannot_read_is_one_line(folder):
    (folder / "ü").mkdir()
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "estbench", "list"], cwd=folder / "ü", capture_output=True,
        env={**os.environ, **locale}, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2
    assert re.fullmatch(rb"estbench: the locale cannot read the name .*; set .*\n", done.stderr)


def test_a_terminal_without_greek(folder):
    process = start("check", "pendulum", env=os.environ | {"PYTHONIOENCODING": "ascii"})
    out, err = process.communicate(timeout=60)
    assert (process.returncode, said(err)) == (0, "")
    assert "initial ?" in out


def test_a_graphics_library_that_does_not_exist(folder):
    process = start("check", "pendulum", env=os.environ | {"MUJOCO_GL": "foo"})
    out, err = process.communicate(timeout=60)
    assert_refused(process.returncode, out, err, "MUJOCO_GL is 'foo'; use egl, osmesa, glfw")


def test_a_reader_that_has_gone(folder):
    process = start("list")
    process.stdout.close()
    assert process.wait(timeout=60) in (0, 1)
    assert process.stderr.read() == ""


def test_ctrl_c(folder):
    process = start("run", "cartpole", "-e", "ekf", "--runs", "100000", "--duration", "0.2",
                    "--out", "x", "--keep", "summary", "--workers", "1")  # fmt: skip
    done = folder / "x" / "data.zarr" / "done" / "c" / "3"  # the fourth batch
    deadline = time.monotonic() + 60
    while not done.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    forecast = re.fullmatch(r"(note: this will take about .*\n)?", said(err))
    assert process.returncode == 130
    assert forecast, err
    assert "interrupted" in out
    with estbench.open_results("x") as tree:
        done = tree["done"].to_numpy()
        count = int(re.search(r"(\d+) of 100000 runs finished", out)[1])
        assert 0 < count <= done.sum() < 100_000
        assert np.isfinite(tree["ekf"]["anees"].to_numpy()[done]).all()


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(), RuntimeError("can't start new thread"), ValueError("Could not allocate"),
        RuntimeError("Caught an unknown exception!"), ImportError("failed to map segment"),
    ],
)  # fmt: skip
def test_no_memory_is_one_line_however_it_is_said(call, monkeypatch, error):
    def fail():
        raise error

    monkeypatch.setattr(cli, "_built", fail)
    code, out, err = call("list")
    assert (code, out) == (2, "")
    assert re.fullmatch(r"estbench: no memory.*; take fewer --runs, .*\n", err)
