"""
# An error budget

Which source causes how much of the error? Linear covariance analysis carries the contribution of
each source through the filter's own gains: the initial error, the process noise, the noise of each
sensor and the bias of the gyro, which this filter does not know. The variances add up to that of
the error.
"""

import matplotlib.pyplot as plt

import estbench

found = estbench.budget("cartpole_bias", "ekf", duration=2.0)
data = found.dataset()
share = data.share.sel(coordinate=["cart", "pole", "cart.vel", "pole.vel"])

figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
left = 0.0
for source in data.source.values:
    width = 100.0 * share.sel(source=source).values
    if width.max() > 1.0:
        axes.barh(share.coordinate.values, width, left=left, label=str(source))
        left = left + width
axes.set(xlabel="share of the variance of the error, %", title="Cart-pole with a biased gyro")
axes.legend(bbox_to_anchor=(1.0, 1.0), loc="upper left")
plt.show()
