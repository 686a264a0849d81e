"""
# A gyro's bias

A pendulum whose encoder and gyro have a constant bias. An EKF that knows nothing of it is
overconfident, and enlarging Q (`more_q`) follows the biased readings all the better. `consider`
allows for the biases in its covariance without estimating them; `bias_ekf` has them as states, and
has the smallest error, of the size that it reports.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import estbench

scenario = Path(estbench.__file__).parents[1] / "examples" / "sensor_bias.toml"
results = estbench.run(scenario, runs=60, duration=3.0)
print(results)

labels = [s.label for s in results.summaries]
error = [1e3 * s.rmse[0].value for s in results.summaries]
sigma = [1e3 * s.std[0] for s in results.summaries]
place = np.arange(len(labels))
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
axes.bar(place - 0.2, error, 0.4, label="RMSE")
axes.bar(place + 0.2, sigma, 0.4, label="σ that the filter reports")
axes.set_xticks(place, [f"{s.label}\n{s.verdict}" for s in results.summaries])
axes.set(ylabel="angle, mrad", title="Pendulum with biased sensors")
axes.legend()
plt.show()
