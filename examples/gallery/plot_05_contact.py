"""
# Contact

A ball falls on the floor. An EKF linearizes at one point, which is above the floor or in it. A
UKF's points lie in the same directions in each step, and its estimate is biased. `rotated_ukf`
turns its points at random in each step and counts the covariance of the linearization error. On
this hard floor neither is consistent, but both stay near 1, where the EKF is beyond 10.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import estbench

scenario = Path(estbench.__file__).parents[1] / "benchmarks" / "drop.toml"
results = estbench.run(scenario, ["ekf", "ukf", "rotated_ukf"], runs=100, duration=1.5)
print(results)

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for label, record in results.records.items():
    nees = record["nees_sum"].sum(axis=0) / record["rank_sum"].sum(axis=0)
    axes.semilogy(results.times, nees, label=f"{label}: {results[label].verdict}")
axes.axhline(1.0, color="grey", linewidth=0.8)
axes.set(xlabel="time, s", ylabel="mean NEES/n", title="A ball that falls on the floor")
axes.legend()
plt.show()
