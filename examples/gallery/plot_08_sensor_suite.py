"""
# A sensor suite

Which sensors does the quadrotor need to know its position to 5 cm and its attitude to 0.02 rad? The
channels are added in the order in which they give most information, along one true run and without
a Monte Carlo. The first ones decide; what comes after the requirement is met buys little.
"""

import matplotlib.pyplot as plt
import numpy as np

import estbench

found = estbench.design("quadrotor", {"root.?": 0.05, "root.r?": 0.02}, duration=1.0, runs=0)
print("chosen:", ", ".join(found.chosen))

names = list(found.names)
worst = {
    "position, m": [names.index(f"root.{a}") for a in "xyz"],
    "attitude, rad": [names.index(f"root.r{a}") for a in "xyz"],
}
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
growing = np.asarray(found.growing)
for (label, at), limit in zip(worst.items(), (0.05, 0.02)):
    (line,) = axes.semilogy(growing[:, at].max(axis=1), "o-", label=label)
    axes.axhline(limit, color=line.get_color(), linestyle=":")
axes.set_xticks(range(len(growing)), ["none", *(f"+ {name}" for name in found.order)])
axes.set(ylabel="largest σ (dotted: required)", title="Quadrotor: what each sensor buys")
axes.legend()
plt.show()
