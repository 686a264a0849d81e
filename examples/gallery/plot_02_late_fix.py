"""
# A late fix, naive and exact

A quadrotor whose position fix is taken ten times a second and arrives 0.1 s late. `exact` goes back
to the time at which the fix was taken and repeats what followed; `naive` takes it as current. The
robot has moved on meanwhile, so each late fix pulls the naive estimate back, and its covariance
does not know of it.
"""

import matplotlib.pyplot as plt

import estbench

results = estbench.run(
    "quadrotor",
    ["exact", "naive"],
    runs=20,
    duration=1.5,
    overrides=[
        "channels.position={rate=10, latency=0.1, noise=0.02}",
        'process_noise.density={"root.v?"=0.5, "root.w?"=2.5e-7}',
        'estimators.exact={type="ekf"}',
        'estimators.naive={type="ekf", delays="naive"}',
        "bound=false",
    ],
)
print(results)

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for label, record in results.records.items():
    nees = record["nees_sum"].sum(axis=0) / record["rank_sum"].sum(axis=0)
    axes.semilogy(results.times, nees, label=f"{label}: {results[label].verdict}")
axes.axhline(1.0, color="grey", linewidth=0.8)
axes.set(xlabel="time, s", ylabel="mean NEES/n", title="Quadrotor with a fix that is 0.1 s late")
axes.legend()
plt.show()
