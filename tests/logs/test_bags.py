"""Rosbags and Parquet files, made here by their own libraries, replayed as the CSV is."""

import csv
from typing import Any

import numpy as np
import pytest

from estbench.errors import LogError
from estbench.logs import files
from estbench.logs.export import export
from estbench.logs.replay import replay
from estbench.scenario.load import load, resolve
from estbench.scenario.log import LogChannel, LogColumns, LogSection

pytest.importorskip("rosbags", reason="the extra logs is not installed")

from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

EPOCH = 1_700_000_000 * 10**9
FORMATS = ("rosbag1", "sqlite", "mcap")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A pendulum's log of 0.5 s as CSV, and the scenario that replays it."""
    folder = tmp_path_factory.mktemp("bags")
    scenario = resolve("pendulum", ["ekf"], runs=1, duration=0.5)
    (folder / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(folder / "scenario.toml", folder / "csv")
    return file, load(folder / "csv" / "scenario.toml"), folder


class Bag:
    """A writer of rosbag1 or rosbag2, of messages by type and fields."""

    def __init__(self, path, form):
        self.first = form == "rosbag1"
        self.types = get_typestore(Stores.ROS1_NOETIC if self.first else Stores.ROS2_HUMBLE)
        storage = rosbag2.StoragePlugin
        self.bag = rosbag1.Writer(path) if self.first else rosbag2.Writer(
            path, version=9, storage_plugin=storage.MCAP if form == "mcap" else storage.SQLITE3
        )  # fmt: skip
        self.bag.open()
        self.topics = {}

    def make(self, type_, **given):
        """A message of which the fields that are not given are 0 or empty."""
        kind = self.types.types[type_]
        return kind(**{
            field: given[field] if field in given else self.empty(*of)
            for field, of in self.types.fielddefs[type_][1]
        })  # fmt: skip

    def empty(self, kind, of):
        if kind.name == "BASE":
            return "" if of[0] == "string" else 0
        if kind.name == "NAME":
            return self.make(of)
        length = of[1] if kind.name == "ARRAY" else 0
        return np.zeros(length)

    def header(self, ns):
        stamp = self.types.types["builtin_interfaces/msg/Time"](sec=ns // 10**9,
                                                                 nanosec=ns % 10**9)  # fmt: skip
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="")

    def write(self, topic, kind, ns, late=0, **fields):
        if topic not in self.topics:
            self.topics[topic] = self.bag.add_connection(topic, kind, typestore=self.types)
        message = self.make(kind, header=self.header(ns), **fields)
        encode = self.types.serialize_ros1 if self.first else self.types.serialize_cdr
        self.bag.write(self.topics[topic], ns + late, encode(message, kind))


def bag_of(rows, folder, form):
    """The log as JointState (encoder, torque) and Imu (gyro)."""
    path = folder / f"{form}.bag" if form == "rosbag1" else folder / form
    bag = Bag(path, form)
    for row in rows:
        ns = EPOCH + round(float(row["time"]) * 1e9)
        torque, encoder = np.array([float(row["u.torque"])]), np.zeros(0)
        if row["encoder"]:
            encoder = np.array([float(row["encoder"])])
        bag.write("/joints", "sensor_msgs/msg/JointState", ns, 2_000_000, name=["hinge"],
                  position=encoder, effort=torque)  # fmt: skip
        if row["gyro.0"]:
            turning = {a: float(row[f"gyro.{i}"]) for i, a in enumerate("xyz")}
            vector = bag.make("geometry_msgs/msg/Vector3", **turning)
            bag.write("/imu", "sensor_msgs/msg/Imu", ns, angular_velocity=vector)
    bag.bag.close()
    return path


SECTION = LogSection(
    time="stamp",
    instants="all",
    channels={
        "encoder": LogChannel(columns=["/joints.position.hinge"]),
        "gyro": LogChannel(columns=[f"/imu.angular_velocity.{a}" for a in "xyz"]),
    },
    controls={"torque": LogColumns(columns=["/joints.effort.hinge"])},
)


@pytest.mark.parametrize("form", FORMATS)
def test_a_bag_is_replayed_as_the_csv(exported, tmp_path, form):
    file, scenario, _ = exported
    with file.open(newline="") as given:
        bag = bag_of(list(csv.DictReader(given)), tmp_path, form)
    # The first reading of the joint is missing: its message is shorter than the others.
    named = {c for t in files.read(bag) for c in t.columns}
    assert {"/joints.effort.hinge", "/imu.orientation.w", "stamp", "received"} <= named
    theirs = replay(scenario.model_copy(update={"log": SECTION}), bag)["ekf"].traces
    ours = replay(scenario, file)["ekf"].traces
    assert theirs.mean == pytest.approx(ours.mean, abs=1e-9)
    assert theirs.nis == pytest.approx(ours.nis, rel=1e-6, nan_ok=True)


def test_an_exported_bag_is_replayed_as_the_csv(tmp_path):
    """With late readings and dropouts: the stamp says when a reading was taken."""
    changes = ["channels.pole_encoder.latency=0.03", "channels.pole_encoder.dropout=0.2"]
    scenario = resolve("cartpole", ["ekf"], runs=1, duration=0.4, overrides=changes)
    (tmp_path / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    logs = {form: export(tmp_path / "scenario.toml", tmp_path / form, form=form)
            for form in ("csv", "mcap")}  # fmt: skip
    csv_, bag = (replay(tmp_path / form / "scenario.toml", paths)["ekf"].traces
                 for form, paths in logs.items())  # fmt: skip
    assert bag.mean == pytest.approx(csv_.mean, abs=1e-9)
    assert bag.nees == pytest.approx(csv_.nees, rel=1e-6)


def test_messages_of_other_types(tmp_path):
    bag = Bag(tmp_path / "many", "sqlite")
    ns = EPOCH + 5
    point = bag.make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    pose = bag.make("geometry_msgs/msg/Pose", position=point)
    force = bag.make("geometry_msgs/msg/Vector3", z=9.0)
    bag.write("/fix", "sensor_msgs/msg/NavSatFix", ns, latitude=48.0, altitude=500.0)
    bag.write("/pose", "geometry_msgs/msg/PoseStamped", ns, pose=pose)
    bag.write("/twist", "geometry_msgs/msg/TwistStamped", ns)
    bag.write("/wrench", "geometry_msgs/msg/WrenchStamped", ns,
              wrench=bag.make("geometry_msgs/msg/Wrench", force=force))  # fmt: skip
    bag.write("/odom", "nav_msgs/msg/Odometry", ns + 10**9, pose=bag.make(
        "geometry_msgs/msg/PoseWithCovariance", pose=pose))  # fmt: skip
    bag.bag.close()
    tables = {t.topic: t.columns for t in files.read(tmp_path / "many")}
    assert tables["/fix"]["/fix.latitude"] == [48.0]
    assert tables["/pose"]["/pose.pose.position.y"] == [2.0]
    assert tables["/wrench"]["/wrench.wrench.force.z"] == [9.0]
    assert tables["/odom"]["/odom.pose.pose.position.z"] == [3.0]
    assert "/odom.pose.covariance[35]" in tables["/odom"]
    assert tables["/odom"]["stamp"] == pytest.approx([1.0])
    assert "/twist.twist.linear.x" in tables["/twist"]


def test_a_bag_that_is_cut_off(exported, tmp_path):
    file, _, _ = exported
    with file.open(newline="") as given:
        bag = bag_of(list(csv.DictReader(given)), tmp_path, "mcap")
    (inside,) = bag.glob("*.mcap")
    inside.write_bytes(inside.read_bytes()[: inside.stat().st_size // 2])
    with pytest.raises(LogError, match=r"cannot be read.*is it cut off"):
        files.read(bag)
    (bag / "metadata.yaml").unlink()
    with pytest.raises(LogError, match="no metadata"):
        files.read(inside)


def test_parquet(exported, tmp_path):
    pa = pytest.importorskip("pyarrow", reason="the extra logs is not installed")
    import pyarrow.parquet as pq

    file, scenario, _ = exported
    (table,) = files.read(file)
    columns = dict(table.columns)
    columns["time"] = pa.array(np.round(columns["time"] * 1e9).astype(np.int64)).cast(
        pa.timestamp("ns")
    )
    columns["note"] = pa.array(["text"] * len(table.rows))
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    ours, theirs = (replay(scenario, f)["ekf"].traces for f in (file, tmp_path / "log.parquet"))
    assert theirs.mean == pytest.approx(ours.mean, abs=1e-9)
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    with pytest.raises(LogError, match="no Parquet file, or is cut off"):
        files.read(tmp_path / "bad.parquet")


def test_one_file_for_each_sensor(exported, tmp_path):
    file, scenario, _ = exported
    (table,) = files.read(file)
    parts = {"a": ["time", "encoder"], "b": ["time", "gyro.0", "gyro.1", "gyro.2"],
             "c": ["time", "u.torque"]}  # fmt: skip
    logs = []
    for name, columns in parts.items():
        logs.append(tmp_path / f"{name}.npz")
        arrays: dict[str, Any] = {c: table.columns[c] for c in columns}
        np.savez(logs[-1], **arrays)
    log = scenario.log.model_copy(update={"truth": None})
    split = scenario.model_copy(update={"log": log})
    theirs, ours = replay(split, logs)["ekf"].traces, replay(scenario, file)["ekf"].traces
    assert np.array_equal(theirs.mean, ours.mean)
    # The clock of a channel is 20 ms late, which its latency says: fused at the time it was taken.
    np.savez(logs[0], time=table.columns["time"] + 0.02, encoder=table.columns["encoder"])
    longer: dict[str, Any] = {"time": np.append(table.columns["time"], 1.0),
                              "u.torque": np.append(table.columns["u.torque"], 0.0)}  # fmt: skip
    np.savez(logs[2], **longer)
    late = replay(split, logs, overrides=["log.channels.encoder.latency=0.02"])["ekf"].traces
    assert late.late.sum() == 0
    assert late.mean[50] != pytest.approx(ours.mean[50], abs=1e-4)  # the last have not come yet
    assert np.nansum(late.nis) == pytest.approx(np.nansum(ours.nis), rel=1e-6)


def test_trajectories_of_a_base(tmp_path):
    scenario = resolve("quadrotor", ["ekf"], runs=2, duration=0.1)
    (tmp_path / "scenario.toml").write_text(scenario.to_toml(), encoding="utf-8")
    (file,) = export(tmp_path / "scenario.toml", tmp_path / "tum", [1], form="tum")
    assert file.name == "run_1.root.truth.tum"
    rows = np.loadtxt(file)
    assert rows.shape[1] == 8
    assert np.linalg.norm(rows[:, 4:], axis=1) == pytest.approx(1.0)
    with pytest.raises(LogError, match="no free joint"):
        export("pendulum", tmp_path / "none", [0], form="tum")
    assert not (tmp_path / "none").exists()
    with pytest.raises(LogError, match="--format is 'bag'"):
        export("pendulum", tmp_path / "none", [0], form="bag")
