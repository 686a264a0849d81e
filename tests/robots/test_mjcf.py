import mujoco
import numpy as np
import pytest

from estbench.errors import ScenarioError
from estbench.experiment import setup
from estbench.robots import added_sensors, compiling, layout, mjcf, parameters, sensor_types
from estbench.scenario import load as scenarios
from estbench.scenario.channels import AddSensor
from estbench.scenario.files import bundled
from tests.helpers import ZOO, zoo_model

CARTPOLE = "estbench:assets/cartpole/cartpole.xml"
HOPPER = "gymnasium:envs/mujoco/assets/hopper.xml"
BITS = mujoco.mjtDisableBit


def cartpole(**options):
    return mjcf.compile_model(mjcf.read(CARTPOLE), **options)


def sensor(kind, obj="", object_type=None):
    return {"added": AddSensor(type=kind, object=obj, object_type=object_type)}


def test_locate(tmp_path):
    assert mjcf.locate(CARTPOLE).name == "cartpole.xml"
    assert mjcf.locate(HOPPER).name == "hopper.xml"
    path = tmp_path / "robot.xml"
    path.touch()
    assert mjcf.locate(str(path)) == path


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("nopackage:a/b.xml", "package 'nopackage' is not installed"),
        ("json.tool:a.xml", "no file .*json/tool/a.xml"),
        ("argparse:a.xml", "'argparse' is a module; use package:path"),
        (".x:a.xml", "package '.x' is not installed"),
        ("a b:a.xml", "package 'a b' is not installed"),
        ("gymnasium:nothing.xml", "model.path 'gymnasium:nothing.xml': no file"),
        ("nothing.xml", "model.path 'nothing.xml': no file"),
        ("estbench:assets", "no file"),
    ],
)
def test_locate_nothing(path, message):
    with pytest.raises(ScenarioError, match=message):
        mjcf.locate(path)


def test_the_package_of_a_path_is_not_imported(tmp_path, monkeypatch):
    inner = tmp_path / "their_robots" / "models"
    inner.mkdir(parents=True)
    (inner.parent / "__init__.py").write_text("raise SystemExit")
    (inner / "robot.xml").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    for path in ("their_robots:models/robot.xml", "their_robots.models:robot.xml"):
        assert mjcf.locate(path) == inner / "robot.xml"


@pytest.mark.parametrize("name", sorted(bundled()))
def test_bundled_models_compile_with_the_flags_the_filters_need(name):
    path = f"estbench:assets/{bundled()[name].parent.name}"
    for file in mjcf.locate(f"{path}/scenario.toml").parent.glob("*.xml"):
        model = mjcf.compile_model(mjcf.read(str(file)))
        for bit in (BITS.mjDSBL_WARMSTART, BITS.mjDSBL_AUTORESET, BITS.mjDSBL_CLAMPCTRL):
            assert model.opt.disableflags & bit


def test_overrides():
    settings = {"body_mass.pole": 0.5, "dof_damping.cart": 3.0, "geom_size.pole": [0.02, 0.4, 0.0]}
    plain, model = cartpole(), cartpole(timestep=0.002, integrator="RK4", settings=settings)
    assert (plain.opt.timestep, model.opt.timestep) == (0.01, 0.002)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.body("pole").mass == 0.5
    assert model.body("cart").mass == plain.body("cart").mass
    np.testing.assert_array_equal(model.dof_damping, [3.0, plain.dof_damping[1]])
    np.testing.assert_array_equal(model.geom("pole").size, [0.02, 0.4, 0.0])
    # Constants that MuJoCo derives follow: the subtree of the cart weighs what its parts weigh.
    np.testing.assert_allclose(model.body_subtreemass[model.body("cart").id], 1.5)


def test_a_dof_field_covers_the_whole_joint():
    model = mujoco.MjModel.from_xml_string(ZOO["joints"])
    before = model.dof_damping.copy()
    parameters.assign(model, "dof_damping.wrist", 7.0)
    parameters.assign(model, "dof_armature.root", [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(model.dof_damping, [*before[:2], 7, 7, 7, *before[5:]])
    np.testing.assert_array_equal(model.dof_armature, [0] * 5 + [1, 2, 3, 4, 5, 6])


def test_overrides_do_not_leak_into_the_spec():
    spec = mjcf.read(CARTPOLE)
    mjcf.compile_model(spec, timestep=0.5, settings={"body_mass.pole": 9.0})
    model = mjcf.compile_model(spec)
    assert model.opt.timestep == 0.01
    assert model.body("pole").mass == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("body_mas.pole", 1.0, r"truth\.set: no model field 'body_mas' .did you mean 'body_mass'"),
        ("opt.gravity", 1.0, "no model field 'opt'"),
        ("body_mass.pol", 1.0, "'body_mass.pol': no body 'pol' .did you mean 'pole'"),
        ("body_mass", 1.0, "'body_mass': no body ''"),
        ("dof_damping.crat", 1.0, "no dof 'crat' .did you mean 'cart'"),
        ("actuator_gear.froce", 1.0, "no actuator 'froce' .did you mean 'force'"),
        ("site_pos.imo", 1.0, "no site 'imo' .did you mean 'imu'"),
        ("geom_size.pole", [1.0, 2.0], "'geom_size.pole' takes 3 numbers, got 2"),
        ("body_mass.pole", [1.0, 2.0], "'body_mass.pole' takes 1 numbers, got 2"),
        ("body_mass.pole", "heavy", "'body_mass.pole' takes 1 numbers, got 'heavy'"),
    ],
)
def test_bad_overrides(key, value, message):
    with pytest.raises(ScenarioError, match=message):
        cartpole(settings={key: value}, where="truth")


def test_muJoCos_own_delays_and_rates_of_sensors_are_cleared():
    xml = ZOO["joints"].replace(
        '<gyro name="gyro" site="imu"/>',
        '<gyro name="gyro" site="imu" nsample="4" delay="0.008" interval="0.02" noise="0.1"/>',
    )
    spec = mujoco.MjSpec.from_string(xml)
    assert spec.compile().nhistory > 0
    model = mjcf.compile_model(spec)
    assert model.nhistory == 0
    assert model.sensor("gyro").noise == 0.1
    assert spec.compile().nhistory > 0  # the caller's spec keeps them


def test_actuator_delays_are_refused():
    motor = '<motor name="swinger" joint="swing"'
    xml = ZOO["joints"].replace(motor, motor + ' nsample="3" delay="0.008"')
    with pytest.raises(ScenarioError, match=r"actuator 'swinger' has nsample=3.*remove nsample"):
        mjcf.compile_model(mujoco.MjSpec.from_string(xml))


@pytest.mark.parametrize(
    ("kind", "obj", "object_type", "width"),
    [
        ("jointpos", "foot_joint", None, 1),
        ("jointvel", "rootx", "joint", 1),
        ("framequat", "torso", "body", 4),
        ("framepos", "foot_geom", "geom", 3),
        ("subtreecom", "torso", None, 3),
        ("clock", "", None, 1),
        ("e_kinetic", "", None, 1),
    ],
)
def test_sensors_are_added_to_a_gymnasium_model(kind, obj, object_type, width):
    before = mjcf.compile_model(mjcf.read(HOPPER)).nsensor
    model = mjcf.compile_model(mjcf.read(HOPPER, sensor(kind, obj, object_type)))
    assert model.nsensor == before + 1
    assert model.sensor("added").type[0] == added_sensors.SENSOR_TYPES[kind]
    assert model.sensor("added").dim[0] == width
    if obj:
        find = {"jointpos": model.joint, "jointvel": model.joint, "framepos": model.geom}
        assert model.sensor("added").objid[0] == find.get(kind, model.body)(obj).id


def test_every_sensor_type_of_mujoco_is_listed():
    assert list(sensor_types.UNITS) == list(added_sensors.SENSOR_TYPES)
    assert all(not sensor_types.UNITS[kind] for kind in sensor_types.JOINT_UNITS)


def test_site_sensors_need_no_object_type():
    model = mjcf.compile_model(mjcf.read(CARTPOLE, sensor("velocimeter", "imu")))
    assert model.sensor("added").objid[0] == model.site("imu").id


@pytest.mark.parametrize(
    ("added", "message"),
    [
        (
            sensor("jointpso", "foot_joint"),
            r"channels\.added\.add\.type: no sensor type 'jointpso' \(did you mean 'jointpos'",
        ),
        (sensor("framepos", "torso", "bodi"), r"channels\.added\.add\.object_type: .* type 'bodi'"),
    ],
)
def test_bad_sensors(added, message):
    with pytest.raises(ScenarioError, match=message):
        mjcf.read(HOPPER, added)


@pytest.mark.parametrize(
    ("kind", "obj", "message"),
    [
        ("jointpos", "foot_jiont", r"no joint 'foot_jiont' \(did you mean 'foot_joint'"),
        ("jointpos", "knee", r"no joint 'knee' \(known: foot_joint, leg_joint, rootx, .*\)$"),
        ("jointpos", "", "no joint '' "),
        ("gyro", "torzo", "no site 'torzo', nor any other site with a name"),
        ("framepos", "torso", "no site 'torso' but a body of this name: give object_type = 'body'"),
    ],
)
def test_a_sensor_on_an_unknown_object(kind, obj, message):
    where = r"^channels\.added\.add\.object: hopper\.xml has "
    with pytest.raises(ScenarioError, match=where + message):
        mjcf.read(HOPPER, sensor(kind, obj))


def test_a_sensor_of_a_kind_that_only_mujoco_checks():
    # MjSpec.copy() leaves out, without a word, what refers to nothing.
    with pytest.raises(ScenarioError, match="added"):
        mjcf.compile_model(mjcf.read(HOPPER, sensor("framepos", "foot", "geom")))


def test_an_added_sensor_with_the_name_of_one_that_is_there():
    message = r"^channels\.gyro\.add: cartpole\.xml has a sensor 'gyro' already; .* leave `add` out"
    with pytest.raises(ScenarioError, match=message):
        mjcf.read(CARTPOLE, {"gyro": AddSensor(type="gyro", object="imu")})


@pytest.mark.parametrize(
    "typo", ['motor name="direct" joint="hinge"', 'jointvel name="rate" joint="hinge"']
)
def test_a_reference_to_nothing_in_the_mjcf(typo, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(ZOO["activations"].replace(typo, typo.replace("hinge", "hingo")))
    with pytest.raises(ScenarioError, match=r"hingo|direct|rate"):
        mjcf.compile_model(mjcf.read(str(path)))


@pytest.mark.parametrize(
    "text", ["", "not xml", "<mujoco><worldbody><body></mujoco>", "<mujoco><nonsense/></mujoco>"]
)
def test_bad_mjcf(text, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as error:
        mjcf.read(str(path))
    assert "robot.xml is not a valid MJCF: " in str(error.value)
    assert "\n" not in str(error.value)


def test_a_model_that_does_not_compile():
    xml = "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>"
    with pytest.raises(ScenarioError, match=r"^filter: MJCF does not compile: .*mass") as error:
        mjcf.compile_model(mujoco.MjSpec.from_string(xml), where="filter")
    assert "\n" not in str(error.value)


KEYS = ZOO["activations"].replace(
    "<sensor>",
    """<keyframe><key name="a" qpos="1 2" qvel="3 4" act="5 6" ctrl="7 8 9"/>
    <key name="b" qpos="9 9"/></keyframe><sensor>""",
)


def test_keyframes():
    model = mujoco.MjModel.from_xml_string(KEYS)
    for key in (None, "a", 0):
        x, u = mjcf.keyframe(model, key)
        np.testing.assert_array_equal(x, [1, 2, 3, 4, 5, 6])
        np.testing.assert_array_equal(u, [7, 8, 9])
    u[0] = 0.0
    assert model.key_ctrl[0, 0] == 7  # the caller's own copy
    for key in ("b", 1):
        np.testing.assert_array_equal(mjcf.keyframe(model, key)[0][:2], [9, 9])


def test_without_keyframes_the_model_rests_at_qpos0():
    model = zoo_model("contact")
    x, u = mjcf.keyframe(model, None)
    np.testing.assert_array_equal(x, [*model.qpos0, *[0] * 6])
    assert u.shape == (0,)


@pytest.mark.parametrize("key", ["c", 2, -1])
def test_no_such_keyframe(key):
    with pytest.raises(ScenarioError, match=f"model.keyframe: no keyframe '{key}'"):
        mjcf.keyframe(mujoco.MjModel.from_xml_string(KEYS), key)


def test_no_keyframe_at_all():
    with pytest.raises(
        ScenarioError, match=r"no keyframe 'home'; the MJCF has none: leave .* out$"
    ):
        mjcf.keyframe(zoo_model("contact"), "home")


SLEEPY = """<mujoco><option timestep="0.005"><flag sleep="enable"/></option><worldbody>
<geom type="plane" size="5 5 .1"/><body name="a" pos="0 0 .11"><freejoint name="a"/>
<geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
<sensor><framepos name="p" objtype="body" objname="a" noise=".01"/></sensor></mujoco>"""


def test_sleep_is_switched_off_with_a_notice(tmp_path):
    (tmp_path / "robot.xml").write_text(SLEEPY)
    prepared = setup.build(scenarios.load(str(tmp_path / "robot.xml")))
    assert not prepared.plant.model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    assert any("sleep" in notice for notice in prepared.notices)


def test_what_a_batch_does_not_support_is_refused_in_one_line(tmp_path):
    (tmp_path / "robot.xml").write_text(
        SLEEPY.replace("<option", '<option integrator="discrete" cone="elliptic"').replace(
            'sleep="enable"', 'ipc="enable"'
        )
    )
    with pytest.raises(ScenarioError, match="cannot step this model in a batch") as error:
        setup.build(scenarios.load(str(tmp_path / "robot.xml"))).simulator(range(1))
    assert "\n" not in str(error.value)


def test_an_actuator_with_several_controls_has_a_name_for_each():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="b" type="ball"/><geom size=".1"/></body><body>'
        '<joint name="h"/><geom size=".1" pos=".1 0 0"/></body></worldbody><actuator>'
        '<orientation name="o" joint="b" kp="10" input="quat"/><motor name="m" joint="h"/>'
        "</actuator></mujoco>"
    )
    assert layout.control_names(model) == ("o.qw", "o.qx", "o.qy", "o.qz", "m")
    assert layout.state_space(model).n == 8


def test_what_mujoco_warns_of_a_file_is_said_once(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(
        """<mujoco><compiler settotalmass="2"/><worldbody><geom type="plane" size="1 1 1"/>
        <body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
    )
    compiling._say.cache_clear()
    with pytest.warns(UserWarning, match="settotalmass") as said:
        setup.build(scenarios.resolve(path))  # several copies are compiled
    assert len(said) == 1
