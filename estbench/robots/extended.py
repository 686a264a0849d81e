"""Sensors added to a compiled model, for a robot of which no MJCF is at hand.

MuJoCo's compiler takes MJCF only, so the compiled model is written in MuJoCo's binary format (MJB:
sizes, options, then every array in the order of `mjModel`), the arrays of sensors and sites are
made longer, and it is read again. What a sensor of a type is (its dimension, the stage that it
needs) is taken from a small robot with the same bodies, joints, sites, ..., which is compiled.
Everything else in the model stays as it is, to the last bit.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco.introspect.structs import STRUCTS
from numpy.typing import NDArray

from estbench.errors import ScenarioError
from estbench.robots import added_sensors, mjcf

_FIELDS = STRUCTS["mjModel"].fields
_ARRAYS = [f.name for f in _FIELDS if getattr(f, "array_extent", None)]
_INTEGERS = [
    f.name for f in _FIELDS if f.name.startswith("n") and f.name not in (*_ARRAYS, "names")
]
_HEADER = 20  # five integers of 4 bytes
_SIZE = 8  # bytes of an integer of `_INTEGERS`
_ALIGNMENT = 64  # bytes; each array of a model begins at a multiple of it
_EMPTY = -1  # in the hash table of names
# The blocks of the hash table, one for each kind of object, in its order.
_NAMED = (
    "nbody", "njnt", "ngeom", "nsite", "ncam", "nlight", "nflex", "nmesh", "nskin", "nhfield",
    "ntex", "nmat", "npair", "nexclude", "neq", "ntendon", "nactuator", "nsensor", "nnumeric",
    "ntext", "ntuple", "nkey", "nplugin",
)  # fmt: skip
_PER_OBJECT = 2  # places of the hash table for each object
_ONE_DOF = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

Arrays = dict[str, NDArray[Any]]


def with_sensors(model: mujoco.MjModel, sensors: Mapping[str, Any], robot: str) -> mujoco.MjModel:
    """A copy of a compiled model with sensors; its own sensors and sites keep their numbers.

    Args:
        model: any compiled model; it is not changed.
        sensors: name -> object with `type`, `object`, `object_type` (see `sections.AddSensor`).
        robot: its name, for messages.

    Raises:
        ScenarioError: a sensor cannot be added.
    """
    small = _small(model)
    for i in range(model.nsensor):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SENSOR, i)
        if name:  # a name in use is refused
            small.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CLOCK)
    declared = len(small.sensors)
    added_sensors.add(small, sensors, robot, "sensors.{}")
    stub = mjcf.compile_model(small, where="sensors")
    out = {name: _array(model, name).copy() for name in _ARRAYS}
    sizes = {name: int(getattr(model, name)) for name in _INTEGERS}
    sites = [
        i
        for i in range(stub.nsite)
        if (mujoco.mj_id2name(stub, mujoco.mjtObj.mjOBJ_SITE, i) or "").startswith("estbench:")
    ]
    names = [mujoco.mj_id2name(stub, mujoco.mjtObj.mjOBJ_SITE, i) for i in sites]
    place = {old: model.nsite + new for new, old in enumerate(sites)}
    for old, new in zip(_others(stub.nsite, sites), range(model.nsite)):
        place[old] = new
    for name in _ARRAYS:
        if name.startswith("site_"):
            out[name] = np.concatenate([out[name], _fitted(_array(stub, name)[sites], out[name])])
        elif name.startswith("sensor_"):
            more = _fitted(_array(stub, name)[declared:], out[name])
            out[name] = np.concatenate([out[name], more])
    fresh = slice(model.nsensor, None)
    _at_sites(out, fresh, place)
    out["sensor_adr"][fresh] += model.nsensordata - stub.sensor_adr[declared]
    out["sensor_historyadr"][fresh] = -1
    out["sensor_plugin"][fresh] = -1
    _name(out, sizes, "site", names)
    _name(out, sizes, "sensor", list(sensors))
    sizes["nsensordata"] += int(stub.nsensordata - stub.sensor_adr[declared])
    return _read(_written(model, out, sizes), model, robot)


def _array(model: mujoco.MjModel, name: str) -> NDArray[Any]:
    value = getattr(model, name)
    return np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value


def _others(count: int, chosen: list[int]) -> list[int]:
    return [i for i in range(count) if i not in chosen]


def _fitted(rows: NDArray[Any], like: NDArray[Any]) -> NDArray[Any]:
    """Rows with as many user values, all zero, as those of another model."""
    if rows.ndim < 2 or rows.shape[1:] == like.shape[1:]:
        return rows.astype(like.dtype)
    return np.zeros((len(rows), *like.shape[1:]), like.dtype)


def _at_sites(out: Arrays, fresh: slice, place: Mapping[int, int]) -> None:
    """Sites have other numbers in the model than in the small robot."""
    for kinds, ids in (("sensor_objtype", "sensor_objid"), ("sensor_reftype", "sensor_refid")):
        here = out[kinds][fresh] == int(mujoco.mjtObj.mjOBJ_SITE)
        out[ids][fresh] = [
            place[i] if at_site else i
            for i, at_site in zip(out[ids][fresh].tolist(), here.tolist())
        ]


def _small(model: mujoco.MjModel) -> mujoco.MjSpec:
    """A robot with the bodies, joints, sites, ... of a model, in their order, with their names."""
    spec = mujoco.MjSpec()
    names = {kind: added_sensors.object_names(model, kind) for kind in added_sensors.KINDS}
    bodies = [spec.worldbody]
    for i in range(1, model.nbody):
        parent = bodies[int(model.body_parentid[i])]
        body = parent.add_body(name=names["body"][i], mocap=bool(model.body_mocapid[i] >= 0))
        body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        bodies.append(body)
    for i, name in enumerate(names["joint"]):
        kind = mujoco.mjtJoint(int(model.jnt_type[i]))
        joint = bodies[int(model.jnt_bodyid[i])].add_joint(name=name, type=kind)
        joint.armature = 1.0  # all bodies are in one place: without it M would be singular
    for i, name in enumerate(names["geom"]):
        bodies[int(model.geom_bodyid[i])].add_geom(name=name, size=[0.1, 0, 0], contype=0)
    for i, name in enumerate(names["site"]):
        bodies[int(model.site_bodyid[i])].add_site(name=name)
    for i, name in enumerate(names["camera"]):
        width, height = model.cam_resolution[i].tolist()
        bodies[int(model.cam_bodyid[i])].add_camera(name=name, resolution=[width, height])
    kinds = zip(names["joint"], model.jnt_type.tolist())
    simple = next((name for name, kind in kinds if kind in _ONE_DOF), None)
    if simple is None:
        simple = "estbench:joint"
        bodies.append(spec.worldbody.add_body(name=simple, mass=1.0, explicitinertial=True))
        bodies[-1].inertia = [1.0, 1.0, 1.0]
        bodies[-1].add_joint(name=simple, type=mujoco.mjtJoint.mjJNT_HINGE)
    for name in names["tendon"]:
        spec.add_tendon(name=name).wrap_joint(simple, 1.0)
    for name in names["actuator"]:
        joint = mujoco.mjtTrn.mjTRN_JOINT
        spec.add_actuator(name=name, target=simple, trntype=joint)
    return spec


def _name(out: Arrays, sizes: dict[str, int], kind: str, names: list[str]) -> None:
    """Give the last objects of a kind their names, and make room for them in the hash table."""
    start, text = sizes["nnames"], out["names"].tobytes()
    addresses = []
    for name in names:
        addresses.append(len(text))
        text += name.encode() + b"\0"
    count = f"n{kind}"
    table = f"name_{kind}adr"
    out[table] = np.concatenate([out[table], np.array(addresses, out[table].dtype)])
    first = _PER_OBJECT * sum(sizes[n] for n in _NAMED[: _NAMED.index(count)])
    old = _PER_OBJECT * sizes[count]
    sizes[count] += len(names)
    fresh = np.full(_PER_OBJECT * sizes[count], _EMPTY, out["names_map"].dtype)
    for i, address in enumerate(out[table].tolist()):
        name = text[address : text.index(b"\0", address)]
        if name:
            at = _hash(name) % len(fresh)
            while fresh[at] != _EMPTY:
                at = (at + 1) % len(fresh)
            fresh[at] = i
    known = out["names_map"]
    out["names_map"] = np.concatenate([known[:first], fresh, known[first + old :]])
    out["names"] = np.frombuffer(text, np.uint8)
    sizes["nnames"] += len(text) - start
    sizes["nnames_map"] = len(out["names_map"])


def _hash(name: bytes) -> int:
    """MuJoCo's hash of a name."""
    value = 5381
    for byte in name:
        value = (((value << 5) + value) ^ byte) & 0xFFFFFFFFFFFFFFFF
    return value


def _written(model: mujoco.MjModel, out: Arrays, sizes: Mapping[str, int]) -> bytes:
    """The binary format of a model with other arrays and sizes."""
    raw = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, raw)
    tail = b"".join(_array(model, name).tobytes() for name in _ARRAYS)
    options = raw[_HEADER + _SIZE * len(_INTEGERS) : len(raw) - len(tail)].tobytes()
    known = [int(getattr(model, name)) for name in _INTEGERS]
    numbers = raw[_HEADER : _HEADER + _SIZE * len(_INTEGERS)].view(np.int64).tolist()
    if raw[len(raw) - len(tail) :].tobytes() != tail or numbers != known:
        raise ScenarioError(
            f"MuJoCo {mujoco.__version__} writes compiled models in a format that estbench does "
            "not know; declare the sensors in the robot's MJCF"
        )
    arrays = b"".join(out[name].tobytes() for name in _ARRAYS)
    start = model.nbuffer - _length(_array(model, name) for name in _ARRAYS)
    sizes = {**sizes, "nbuffer": start + _length(out.values())}
    head = np.array([sizes[name] for name in _INTEGERS], np.int64).tobytes()
    return raw[:_HEADER].tobytes() + head + options + arrays


def _length(arrays: Iterable[NDArray[Any]]) -> int:
    """Bytes of MuJoCo's buffer of arrays, each of which begins at a multiple of 64."""
    total = 0
    for array in arrays:
        total += -total % _ALIGNMENT + array.nbytes
    return total


def _read(data: bytes, model: mujoco.MjModel, robot: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_binary_path("extended.mjb", {"extended.mjb": data})
