# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What force acts on the next finger, and which drive can nearly everybody feel?
#
# Fingers differ. From records of eight fingers on one panel (simulated by ngspice, so the truth is known), this
# notebook estimates the population, not only these eight. All forces are computed with eq. (22) of the reference paper;
# none is measured, and the records do not test that law.

# %%
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fitact

plt.style.use("style.mplstyle")
FOLDER = Path("../data_synth/records/fingers")
scene = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "trapezoid", "rise_time": "50 us"},
        "measurement": {"channels": ["Vsc", "I"]},
        "prior": {"Ci": {"median": "1.35 nF", "relative_sd": 0.1}},
    }
)
records = [fitact.read(path, scene) for path in sorted(FOLDER.glob("finger*.csv.gz"))]
truth = json.loads((FOLDER / "truth.json").read_text())

# %% [markdown]
# ## The population
#
# log Rsc and log Csc are normal over fingers, with a correlation. Ci is assumed common to all fingers, which means that
# all contact areas are equal; `[population] contact_area = "varies"` drops this assumption. The population
# parameters are sampled; the parameters of each finger are integrated out.

# %%
people = fitact.population(records, scene, seed=1, progress=False)
assert people.trusted
people

# %%
people.plot()
plt.show()
low, high = np.quantile(people.new_fingers()["force_mean"], [0.05, 0.95])
print(f"mean force on a new finger: {1e6 * low:.0f} to {1e6 * high:.0f} µN (90 %)")
logs = np.log([[x["Rsc"], x["Csc"]] for x in truth])
draws = people.parameters()
for name, spread in zip(("Rsc", "Csc"), logs.std(axis=0, ddof=1), strict=True):
    inside = np.quantile(draws[f"log_sd_{name}"], [0.01, 0.99])
    print(f"log sd of {name}: {spread:.2f} for the eight, {inside[0]:.2f} to {inside[1]:.2f} for the population (98 %)")
    assert inside[0] < spread < inside[1]
assert high / low > 4

# %% [markdown]
# ## Between-finger variance and parameter uncertainty
#
# The predictive variance has two parts. Fingers differ, which no measurement changes. And eight fingers determine the
# population parameters only approximately, which more fingers improve. With the first three fingers alone:

# %%
three = fitact.population(records[:3], scene, seed=1, progress=False)
shares = {
    name: found.to_dict()["new_finger"]["force_mean"]["variance"]["people"]
    for name, found in {"3 fingers": three, "8 fingers": people}.items()
}
print(", ".join(f"{name}: {100 * share:.0f} % between fingers" for name, share in shares.items()))
assert shares["8 fingers"] > shares["3 fingers"]
assert people.shares["force_mean"]["Csc"]["first"] > 0.5

# %% [markdown]
# The skin's capacitance dominates: the divider g = Ci / (2 Ci + Csc) is the fraction of each jump that appears as Vsc.

# %% [markdown]
# ## A drive that 95 % of people feel
#
# You state the detection threshold; fitact supplies none. The AC amplitude of 0.1 mN, equal at all frequencies, is only
# an example, so do not apply these voltages to people. `fitact design drive` does the same, and checks the limits of
# breakdown and current that you state.

# %%
panel = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "trapezoid", "rise_time": "50 us"},
        "perception": {"threshold_force": "0.1 mN"},
    }
)
design = fitact.design_drive(panel, people, share=0.95)
design.plot()
plt.show()
half = {name: np.median(needed) for name, needed in design.needed.items()}
nearly_all = {name: option.assured for name, option in design.options.items()}
for name, volts in nearly_all.items():
    print(f"{name:10} 50 %: {half[name]:.0f} V; 95 %, upper tolerance limit: {volts:.0f} V peak to peak")
assert half["square"] < 0.8 * half["sine"]
assert nearly_all["square"] / half["square"] > 1.2 * nearly_all["sine"] / half["sine"]

# %% [markdown]
# For half of the people, the square needs the lowest voltage. For nearly all it needs about as much as the sine: if
# Rsc Csc is large, Vsc hardly decays between the edges, so the force of a square is nearly constant, and a constant
# force is not felt.

# %% [markdown]
# ## What to take away
#
# - The computed force on a new finger is uncertain severalfold, however well each finger is measured: fingers differ.
# - The result separates between-finger variance from parameter uncertainty. More fingers reduce only the second.
# - Csc contributes most to the variance of the force, through the divider g.
# - The best waveform depends on the fraction of people: a square for most, no advantage over a sine for nearly all.
