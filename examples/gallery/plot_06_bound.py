"""
# How good it could be

The posterior Cramér-Rao bound is the smallest mean square error that any estimator can have on
these readings. Here Q is varied over eight decades. Near the right value the EKF reaches the bound;
far above it the filter differentiates its readings, and the error is several times the bound, which
the word *conservative* does not say. Efficiency, the bound over the mean square error, does.
"""

import matplotlib.pyplot as plt
import numpy as np

import estbench

scales = 10.0 ** np.arange(-3, 6)
labels = [f"q{k}" for k in range(len(scales))]
tables = [
    f'estimators.{label}={{type="ekf", filter={{process_noise_scale={scale:g}}}}}'
    for label, scale in zip(labels, scales)
]
results = estbench.run("pendulum", labels, runs=60, duration=2.0, overrides=tables)

velocity = results.names.index("hinge.vel")
rmse = np.array([results[label].rmse[velocity].value for label in labels])
bound = rmse * np.array([results[label].efficiency_each[velocity].value for label in labels]) ** 0.5
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
axes.loglog(scales, rmse, "o-", label="EKF")
axes.axhline(bound[0], color="black", linewidth=0.8, label="bound")
for scale, error, label in zip(scales, rmse, labels):
    axes.annotate(str(results[label].verdict), (scale, error), rotation=60, fontsize=7,
                  xytext=(0, 5), textcoords="offset points")  # fmt: skip
axes.set(xlabel="filter's Q over the true Q", ylabel="RMSE of the velocity, rad/s",
         title="Pendulum: the error over Q, and the bound", xlim=(3e-4, 3e6),
         ylim=(None, 8 * rmse.max()))  # fmt: skip
axes.legend(loc="lower right")
plt.show()
