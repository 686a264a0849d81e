import pytest

from estbench.errors import EstimatorError, ScenarioError
from estbench.estimators.ekf import EKF
from estbench.robots import mjcf
from estbench.scenario.files import bundled
from estbench.scenario.load import load, override, resolve

MINIMAL = 'name = "mine"\n[model]\npath = "robot.xml"\n'


def write(folder, text, name="scenario.toml"):
    path = folder / name
    path.write_text(text)
    return path


def test_bundled_names():
    assert {"pendulum", "cartpole", "cartpole_imu", "acrobot", "quadrotor"} <= set(bundled())


@pytest.mark.parametrize("name", sorted(bundled()))
def test_bundled_scenarios_load_and_round_trip(name, tmp_path):
    scenario = load(name)
    assert scenario.name == name
    assert scenario.model.path.startswith("estbench:assets/")
    assert mjcf.locate(scenario.model.path).is_file()
    assert "divergence_threshold" in scenario.to_toml()  # defaults are spelled out
    path = write(tmp_path, scenario.to_toml())
    assert load(path) == scenario
    assert load(tmp_path) == scenario  # a results folder holds its scenario


def test_every_kind_of_value_survives_the_round_trip(tmp_path):
    scenario = load(
        "cartpole",
        [
            "initial.std=[0.1, 0.2, 0.3, 0.4]",
            'model.set."body_mass.pole"=0.3',
            'truth.draw."body_mass.pole".relative_std=0.1',
            "model.keyframe=0",
            'channels.gyro={noise=[0.1, 0.2, 0.3], rate=50, add={type="gyro", object="imu"}}',
            "process_noise.matrix=[[1.0, 0.0], [0.0, 2.0]]",
            "estimators={a={type='ukf', alpha=0.5, redraw=false}, b={type='ekf'}}",
        ],
    )
    assert scenario.model.keyframe == 0
    assert scenario.estimators["a"] == {"type": "ukf", "alpha": 0.5, "redraw": False}
    assert scenario.channels["gyro"].noise == [0.1, 0.2, 0.3]
    assert scenario.channels["gyro"].add.object == "imu"
    assert load(write(tmp_path, scenario.to_toml())) == scenario


def test_a_bare_mjcf_is_a_scenario(tmp_path):
    path = write(tmp_path, "<mujoco/>", "robot.xml")
    scenario = load(path)
    assert scenario.name == "robot"
    assert scenario.model.path == str(path)
    assert list(scenario.estimators) == ["ekf", "ukf"]


def test_relative_paths_are_the_scenario_files(tmp_path, monkeypatch):
    (tmp_path / "sub").mkdir()
    write(tmp_path, "<mujoco/>", "robot.xml")
    text = MINIMAL.replace("robot.xml", "../robot.xml") + '[filter]\npath = "pkg:a/b.xml"\n'
    write(tmp_path / "sub", text)
    monkeypatch.chdir(tmp_path)
    scenario = load("sub")
    assert scenario.model.path == str(tmp_path / "robot.xml")
    assert scenario.filter.path == "pkg:a/b.xml"


@pytest.mark.parametrize(
    ("text", "section", "key", "value"),
    [
        ("simulation.runs=7", "simulation", "runs", 7),
        ("model.keyframe=upright", "model", "keyframe", "upright"),
        ('model.keyframe="upright"', "model", "keyframe", "upright"),
        ("initial.std=0.5", "initial", "std", 0.5),
        ('initial.std={"*"=1.0}', "initial", "std", {"*": 1.0}),
        ('initial.std."*.vel"=3', "initial", "std", {"*": 0.05, "*.vel": 3.0}),
        (" simulation.duration = 2.5 ", "simulation", "duration", 2.5),
        ("consistency.level=0.9", "consistency", "level", 0.9),  # a section the file has not
    ],
)
def test_overrides(text, section, key, value):
    scenario = load("cartpole", [text])
    assert getattr(getattr(scenario, section), key) == value
    assert override(load("cartpole"), [text]) == scenario


def test_override_leaves_its_argument_alone():
    scenario = load("cartpole")
    override(scenario, ['initial.std."*"=9', "estimators.ekf.covariance_update=simplified"])
    assert scenario == load("cartpole")


def test_an_overriding_path_is_relative_to_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = load("cartpole", ["filter.path=other.xml"])
    assert scenario.filter.path == str(tmp_path / "other.xml")
    assert scenario.model.path == "estbench:assets/cartpole/cartpole.xml"


def test_the_last_override_wins():
    assert load("cartpole", ["simulation.runs=7", "simulation.runs=8"]).simulation.runs == 8


def test_every_mistake_is_named_at_once_with_its_path():
    with pytest.raises(ScenarioError) as error:
        load(
            "cartpole",
            [
                "simulation.runs=0",
                "simulation.duraton=3",
                "filter.differences=backward",
                "channels.pole_encoder.nois=0.1",
                "modle.path=x",
                "process_noise.density=[1, nan]",
            ],
        )
    message = str(error.value)
    assert message.startswith("cartpole: ")
    assert "simulation.runs: Input should be greater than or equal to 1, got 0" in message
    assert "simulation.duraton: unknown key (did you mean 'duration'?)" in message
    assert "filter.differences: Input should be 'forward' or 'centered', got 'backward'" in message
    assert "channels.pole_encoder.nois: unknown key (did you mean 'noise'?)" in message
    assert "modle: unknown key (did you mean 'model'" in message
    assert "process_noise.density" in message


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("channels.gyro.add.typ=x", "channels.gyro.add.typ: unknown key (did you mean 'type'?)"),
        (
            'truth.draw."body_mass.pole".relativ_std=1',
            "truth.draw.body_mass.pole.relativ_std: unknown key (did you mean 'relative_std'?)",
        ),
    ],
)
def test_did_you_mean_in_nested_tables(text, hint):
    with pytest.raises(ScenarioError) as error:
        load("cartpole", [text])
    assert hint in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("simulation.runs", r"--set 'simulation.runs' is not of the form section\.key=value"),
        ("=3", "not of the form"),
        ("a b=3", "'a b' is not a dotted TOML key"),
        ("name.first=x", "'name' is a value, not a section"),
        ("estimators={}", "estimators is empty"),
        ("model=3", "model: .*got 3"),
        ("model.frame_skip=1.5", r"model\.frame_skip: "),
        ("#simulation.runs=3", "not a dotted TOML key"),
    ],
)
def test_bad_overrides(text, message):
    with pytest.raises(ScenarioError, match=message):
        load("cartpole", [text])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = ?", r"scenario\.toml is not valid TOML: .*line 1"),
        ('name = "a"\nname = "b"', "not valid TOML"),
        ('name = "a"', "model: Field required"),
        ("[model]\npath = 'a.xml'", "name: Field required"),
        (MINIMAL + "set = 3", r"model\.set: .*got 3"),
        (MINIMAL + "[simulation]\nruns = 'many'", r"simulation\.runs: .*got 'many'"),
    ],
)
def test_bad_files(text, message, tmp_path):
    with pytest.raises(ScenarioError, match=message):
        load(write(tmp_path, text))


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScenarioError, match="not valid TOML"):
        load(path)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("cartpol", "no scenario 'cartpol' .did you mean 'cartpole'"),
        ("nowhere.toml", "no file 'nowhere.toml'"),
        ("nowhere.xml", "no file 'nowhere.xml'"),
    ],
)
def test_nothing_there(source, message):
    with pytest.raises(ScenarioError, match=message):
        load(source)


def test_a_file_of_another_kind(tmp_path):
    with pytest.raises(ScenarioError, match=r"neither \.toml nor \.xml"):
        load(write(tmp_path, "", "robot.urdf"))


def test_a_scenario_cannot_be_changed():
    with pytest.raises(ValueError, match="frozen"):
        load("cartpole").simulation.runs = 3


class Mine(EKF):
    """Found as tests.scenario.test_load:Mine."""


def test_one_estimator_needs_no_list_and_a_class_no_name():
    mine = {"type": f"{__name__}:Mine"}
    assert resolve("pendulum", "ekf").estimators == {"ekf": {}}
    assert resolve("pendulum", Mine).estimators == {"Mine": mine}
    assert resolve("pendulum", [Mine, "ekf"]).estimators == {"Mine": mine, "ekf": {}}
    with pytest.raises(EstimatorError, match="no estimator 'ekff'"):
        resolve("pendulum", "ekff")
    with pytest.raises(EstimatorError, match="estimator 3 is neither a name nor a class"):
        resolve("pendulum", [3])

    class Local(EKF):
        pass

    with pytest.raises(EstimatorError, match=r"cannot be imported as .*Local; define it"):
        resolve("pendulum", Local)


def test_the_table_of_a_label_holds_for_a_class_of_that_name():
    settings = [
        "estimators.Mine={delays='naive'}",
        "estimators.Mine.start={inflate=2.0}",
    ]
    expected = {"delays": "naive", "start": {"inflate": 2.0}, "type": f"{__name__}:Mine"}
    assert resolve("pendulum", Mine, overrides=settings).estimators == {"Mine": expected}


def test_tables_of_a_file_need_not_be_run(tmp_path):
    tables = f'{MINIMAL}[estimators.ekf]\n[estimators.other]\ntype = "ukf"\nalpha = 0.5\n'
    path = write(tmp_path, tables)
    assert resolve(path, ["ekf"]).estimators == {"ekf": {}}
