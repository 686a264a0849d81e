"""
# A wrong Q

The same EKF with a process noise that is right, a hundred times too small, and a hundred times too
large. NEES/n, the squared error in units of the filter's own covariance, is 1 for the right one.
With the small Q the filter trusts its model, is wrong and does not know it: overconfident. With the
large one its error grows a little, and its covariance much more: conservative. RMSE alone would not
tell the two apart.
"""

import matplotlib.pyplot as plt

import estbench

scales = {"too_small": 0.01, "right": 1.0, "too_large": 100.0}
tables = [
    f'estimators.{label}={{type="ekf", filter={{process_noise_scale={scale}}}}}'
    for label, scale in scales.items()
]
results = estbench.run("cartpole", list(scales), runs=100, duration=3.0, overrides=tables)
print(results)

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for label, record in results.records.items():
    nees = record["nees_sum"].sum(axis=0) / record["rank_sum"].sum(axis=0)
    axes.semilogy(results.times, nees, label=f"{label}: {results[label].verdict}")
axes.axhline(1.0, color="grey", linewidth=0.8)
axes.set(xlabel="time, s", ylabel="mean NEES/n", title="Cart-pole, EKF with three values of Q")
axes.legend()
plt.show()
