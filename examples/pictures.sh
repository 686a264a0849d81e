#!/usr/bin/env bash
# Makes the pictures of README and docs: docs/images/*.png.
#
# The README's: a quadrotor whose position fix comes ten times a second and 0.1 s late, filtered by the same EKF
# twice: `exact` goes back to the time of the fix and replays, `naive` takes it as current.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
late=(
  --set channels.position.rate=10 --set channels.position.latency=0.1
  --set channels.position.noise=0.02
  --set 'process_noise.density={ "root.v?" = 0.5, "root.w?" = 2.5e-7 }'
)
estbench run quadrotor "${late[@]}" --runs 60 --out "$folder/store" \
  --set 'estimators={ exact = { type = "ekf" }, naive = { type = "ekf", delays = "naive" } }'
estbench plot "$folder/store" --what nees --format png --out docs/images/nees.png
estbench video "$folder/store" -e exact --run 7 --at 1.6 --width 480 --height 360 \
  --out docs/images/ghost.png
python - <<'PICTURE'
import gymnasium as gym
import estbench.envs
from PIL import Image

env = gym.make("estbench/Quadrotor-v0", render_mode="rgb_array", width=480, height=320)
env.reset(seed=3)
for _ in range(12):
    env.step(env.action_space.sample() * 0)
Image.fromarray(env.render()).save("docs/images/environment.png", optimize=True)
env.close()
PICTURE

# Those of docs/sensors.md.
estbench sensors quadrotor_delayed --out docs/images/sensors.png
python - <<'END'
from estbench.sensors import allan
from estbench.montecarlo import run as experiment
from estbench.experiment import setup

overrides = ["channels.gyro.noise_density=0.002", "channels.gyro.bias_instability=0.002"]
prepared = setup.build(experiment.resolve("cartpole_imu", overrides=overrides))
gyro = next(c for c in prepared.channels if c.name == "gyro")
allan.plot(gyro, duration=1200.0, runs=4).savefig("docs/images/allan.png", dpi=100)

from PIL import Image  # fewer colours, a quarter of the size

name = "docs/images/sensors.png"
Image.open(name).convert("P", palette=Image.Palette.ADAPTIVE, colors=64).save(name, optimize=True)
END

# That of docs/tuning.md.
estbench sweep quadrotor -e ekf --runs 24 --duration 1 --over channels.position.rate=5,10,25,50 \
  --over channels.position.noise=0.005,0.01,0.02,0.05 --plot docs/images/sweep.png

# That of docs/contact.md.
python examples/rotated_points.py docs/images/contact.png

# The robots with legs of docs/contact.md.
python - <<'END'
import mujoco
import numpy as np
from PIL import Image

from estbench.experiment import setup
from estbench.experiment.recording import trajectory
from estbench.montecarlo import run as experiment

VIEWS = {"quadruped": (1.25, (0.2, 0.7, 1.0, 1.3)), "biped": (0.85, (0.2, 0.9, 1.3, 1.9))}
rows = []
for robot, (distance, times) in VIEWS.items():
    prepared = setup.build(experiment.resolve(robot))
    x, model = trajectory(prepared, [0]).x[:, 0], prepared.plant.model
    data, renderer = mujoco.MjData(model), mujoco.Renderer(model, 220, 250)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = distance, 110, -12
    camera.lookat = [0.08, 0.0, 0.17 if robot == "quadruped" else 0.2]
    row = []
    for time in times:
        at = x[np.searchsorted(prepared.times, time)]
        data.qpos, data.qvel = at[: model.nq], at[model.nq : model.nq + model.nv]
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera)
        row.append(renderer.render())
    rows.append(np.concatenate(row, axis=1))
    renderer.close()
name = "docs/images/walking.png"
image = Image.fromarray(np.concatenate(rows)).convert("P", palette=Image.Palette.ADAPTIVE, colors=128)
image.save(name, optimize=True)
END
