"""Environments that change what a filter believes: models, mocap bodies, forces, constraints."""

import gymnasium as gym
import mujoco
import numpy as np

ARM = """<mujoco><option timestep="0.004"/><worldbody>
  <body name="hand" mocap="true" pos="0.5 0 0.2"><geom size="0.02" contype="0"/></body>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.5"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0"/>
    <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0"/>
      <body name="wrist" pos="0.3 0 0"><joint name="wrist" axis="0 1 0" damping="0.5"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.03" contype="0"/></body></body></body>
  </worldbody>
  <equality><connect body1="hand" body2="wrist" anchor="0 0 0" solref="0.05 1"/></equality>
  <actuator><motor name="motor" joint="shoulder" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>"""


class Arm(gym.Env):
    """Three links whose end a mocap body holds by a soft constraint.

    Args:
        kind: what changes.
    """

    def __init__(self, kind="mocap"):
        self.kind, self.frame_skip = kind, 5
        self.model = mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)
        self.observation_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.spaces.Box(-1, 1, (1,))
        self.count = 0

    def reset(self, *, seed=None, options=None):
        """The kinds that change at a reset do it here."""
        super().reset(seed=seed)
        draw = float(self.np_random.uniform(0.3, 3.0))
        if self.kind == "compiled":  # another model and other data
            self.model = mujoco.MjModel.from_xml_string(ARM.replace('0.03"', f'{0.03 * draw:g}"'))
            self.data = mujoco.MjData(self.model)
        mujoco.mj_resetData(self.model, self.data)
        if self.kind == "mass":
            self.model.body_mass[2:] = draw
            mujoco.mj_setConst(self.model, self.data)
        if self.kind == "options":
            self.model.opt.gravity[:] = [draw, 0, -3]
            self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        if self.kind == "gains":
            self.model.actuator_gainprm[0, 0], self.model.actuator_ctrlrange[0] = draw, [-5, 5]
        self.data.qpos[:] = self.np_random.uniform(-0.1, 0.1, 3) + np.array([0.6, -1.2, 0.0])
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        """The kinds that change in an episode do it here."""
        self.count += 1
        self.data.ctrl[:] = action
        if self.kind == "mocap":
            self.data.mocap_pos[0] += [0.01 * np.sin(self.count), 0, 0.004]
        if self.kind == "damping" and self.count == 4:
            self.model.dof_damping[:] = 3.0
        if self.kind == "push":
            self.data.xfrc_applied[3, 2] = 4.0 * (self.count % 3)
            self.data.qfrc_applied[0] = 0.5
        if self.kind == "released" and self.count == 4:
            self.data.eq_active[0] = 0
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        return np.zeros(1, np.float32), 0.0, False, self.count >= 12, {}
