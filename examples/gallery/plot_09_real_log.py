"""
# A real pendulum's log

A motor-driven pendulum swings up; its encoder and torque were recorded. There is no truth, so the
innovations judge the filter: NIS/m 1 and no correlation. The speed is held out, and predicted. The
real encoder is quantized and the joint has dry friction, so the innovations are not white; the
recorded speed has outliers, beyond the band and the picture. The log is in the folder that
`ESTBENCH_DATA` names; without it, a simulated log of the same robot is used.
"""

import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import estbench
from estbench.logs.export import export

folder = Path(os.environ.get("ESTBENCH_DATA", "shared/data")) / "real_pendulum"
real = (folder / "swing_up_1.csv").is_file()
if real:
    scenario, log = "real_pendulum", folder / "swing_up_1.csv"
else:
    logs = Path(tempfile.mkdtemp()) / "logs"
    (log,) = export("real_pendulum", logs, [0])
    scenario = logs / "scenario.toml"
found = estbench.replay(scenario, log, ["ekf", "ukf"], hold_out=["speed"])

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for r in found.replayed:
    (p,) = r.predictions
    name = f"{r.label}: NIS/m {r.innovations.nis.value:.2f}, {r.innovations.verdict}"
    axes.plot(p.times, p.error[:, 0], linewidth=0.8, label=name)
    axes.fill_between(p.times, -2 * p.std[:, 0], 2 * p.std[:, 0], alpha=0.15)
source = "A recorded swing-up" if real else "A simulated log"
axes.set(xlabel="time, s", ylabel="speed: reading - prediction, rad/s",
         title=f"{source}, the speed held out (band: 2σ)", ylim=(-3, 3))  # fmt: skip
axes.legend()
plt.show()
