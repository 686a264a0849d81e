"""
# Outliers

Some readings of the encoder are far off. The EKF follows each one. A gate leaves a reading out
that its innovation makes improbable; Huber's and Student's updates give it less weight. All three
cut the error to a third, and remain a little overconfident: some outliers are small enough to pass.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import estbench

scenario = Path(estbench.__file__).parents[1] / "examples" / "outliers.toml"
results = estbench.run(scenario, runs=60, duration=2.0)
print(results)

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for label, record in results.records.items():
    rmse = record["square_sum"].sum(axis=0)[:, 0] / record["count"].sum(axis=0)
    axes.semilogy(results.times, 1e3 * rmse**0.5, label=f"{label}: {results[label].verdict}")
unit = results.units[0]
axes.set(xlabel="time, s", ylabel=f"RMSE of {results.names[0]}, 1e-3 {unit}", title="Outliers")
axes.legend()
plt.show()
