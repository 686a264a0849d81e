"""MuJoCo robots as state-space models; the only package that imports `mujoco.batch`."""
