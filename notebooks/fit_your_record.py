# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What are this finger's Rsc and Csc, and how sure am I?
#
# From a CSV of an oscilloscope to parameters, their posterior and the force. The record here ships with the
# project; put the path of your own in its place.

# %%
import matplotlib.pyplot as plt
import numpy as np

import fitact

scene = fitact.Scene.load("../data_synth/records/finger_direct.toml")
record = fitact.read("../data_synth/records/finger_direct.csv", scene)
fit = fitact.fit(record, scene)
print(fit)

# %% [markdown]
# The verdict matters more than the numbers: the record fixes the divider g and the time constant b to a few parts
# in ten thousand, and says nothing about the contact area. What is known of that comes from the prior on Ci.

# %%
posterior = fitact.sample(fit, seed=1, progress=False)
print(posterior.convergence)

# %%
draws = posterior.parameters()
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
left.plot(draws["Rsc"].ravel() / 1e3, draws["Ci"].ravel() * 1e9, ".", ms=1)
left.set_xlabel("Rsc (kΩ)")
left.set_ylabel("Ci (nF)")
left.set_title("One combination is left open: a line")
right.hist(1e6 * posterior.force()["force_mean"].ravel(), bins=60)
right.set_xlabel("mean force (µN)")
right.set_title("and the force is known no better than Ci")
plt.show()

# %% [markdown]
# ## What to take away
#
# - g and b are the record's; Rsc, Csc, Ci and the force inherit the width of the prior on Ci.
# - More of the same data will not help. The current, a known series resistor or a better Ci will.

# %%
quantities = draws | posterior.derived()
for name in ("Rsc", "Csc", "Ci", "force_mean", "g", "b"):
    print(f"{name:12} ± {100 * np.std(np.log(quantities[name])):.3g} %")
