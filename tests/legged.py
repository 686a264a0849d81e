"""A hovering base with two feet on slides: the smallest robot with legs, for tests."""

import mujoco
import numpy as np

from estbench.robots import layout, mjcf
from estbench.robots.disturbance import Disturbance
from estbench.robots.model import MujocoModel, SensorChannel

AXES = ("x", "y", "z")
LEG = """
<body name="{n}x"><joint name="{n}_x" type="slide" axis="1 0 0"/><geom size=".01"/>
<body name="{n}y"><joint name="{n}_y" type="slide" axis="0 1 0"/><geom size=".01"/>
<body name="{n}z" pos="{p}"><joint name="{n}_z" type="slide" axis="0 0 1"/><geom size=".01"/>
{sole}<site name="{n}_foot" pos="0 0 -.1"/></body></body></body>"""
SLIDES = """<mujoco><option timestep="0.01"/><default><geom mass=".1"/></default><worldbody>
<body name="base"><freejoint name="root"/><geom size=".1"/>
<site name="imu" pos="{offset}" quat="{axes}"/>{legs}</body></worldbody>
<sensor><gyro name="gyro" site="imu"/><accelerometer name="accelerometer" site="imu"/>
{encoders}<touch name="a_touch" site="a_foot"/><touch name="b_touch" site="b_foot"/></sensor>
</mujoco>"""
NOISE = {"gyro": 0.01, "accelerometer": 0.1, "touch": 0.5, "encoder": 0.002}


def xml(offset="0 0 0", axes="1 0 0 0", radius=None):
    """MJCF of the robot with its IMU at a place of the base, its feet points or spheres."""
    sole = "" if radius is None else f'<geom pos="0 0 -.1" size="{radius}"/>'
    return SLIDES.format(
        offset=offset,
        axes=axes,
        legs=LEG.format(n="a", p=".2 .1 -.3", sole=sole)
        + LEG.format(n="b", p="-.2 -.1 -.3", sole=sole),
        encoders="".join(
            f'<jointpos name="{n}_{a}_encoder" joint="{n}_{a}"/>' for n in "ab" for a in AXES
        ),
    )


def robot(text, density=0.0, kind="additive"):
    """The filter's model of an MJCF: each sensor a channel, its noise by the last word."""
    model = mjcf.compile_model(mujoco.MjSpec.from_string(text))
    channels = []
    for i in range(model.nsensor):
        name = layout.sensor_name(model, i)
        std = NOISE[name.split("_")[-1]]
        channels.append(SensorChannel(name, i, std**2 * np.eye(model.sensor_dim[i])))
    noise = Disturbance.build(model, layout.state_space(model), kind, density)
    return MujocoModel(model, channels, noise)
