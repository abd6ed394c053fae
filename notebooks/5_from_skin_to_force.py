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
# all contact areas are equal; `[population] contact_area = "varies"` drops this assumption. emcee samples the
# population parameters; the parameters of each finger are integrated out.

# %%
people = fitact.population(records, scene, seed=1, progress=False)
assert people.trusted
print(people)

# %%
new = people.new_fingers()
every = np.random.default_rng(0).choice(new["Rsc"].size, 4000, replace=False)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2))
left.loglog(
    1e-3 * new["Rsc"].ravel()[every], 1e9 * new["Csc"].ravel()[every], ".", ms=2, alpha=0.3, label="new fingers"
)
left.plot([1e-3 * x["Rsc"] for x in truth], [1e9 * x["Csc"] for x in truth], "o", color="C1", label="the eight, truth")
fitted = [[finger.parameters[name]["q50"] for finger in people.fingers] for name in ("Rsc", "Csc")]
left.plot(1e-3 * np.array(fitted[0]), 1e9 * np.array(fitted[1]), "x", color="k", label="the eight, fitted")
left.set(xlabel="Rsc (kΩ)", ylabel="Csc (nF)", title="Skins")
left.set_xticks([50, 100, 200, 400], ["50", "100", "200", "400"])
left.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
left.minorticks_off()
left.legend(markerscale=1.5)
force = 1e6 * new["force_mean"]
right.hist(force.ravel(), bins=np.geomspace(10, 3000, 60), color="C2")
right.set(xscale="log", xlabel="mean force (µN)", ylabel="draws", title="Mean force on a new finger")
low, high = np.quantile(force, [0.05, 0.95])
for edge, where, share in ((low, "right", "5 %"), (high, "left", "95 %")):
    right.axvline(edge, color="k", ls="--", lw=1)
    right.text(edge, 0.97, f"  {share}: {edge:.0f} µN  ", ha=where, va="top", transform=right.get_xaxis_transform())
plt.show()
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
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4))
shares = {}
for row, (name, found) in enumerate({"3 fingers": three, "8 fingers": people}.items()):
    part = found.to_dict()["new_finger"]["force_mean"]["variance"]
    shares[name] = part["people"]
    left.barh(row, part["people"], color="C0", label="between fingers" if row == 0 else None)
    left.barh(
        row, part["ignorance"], left=part["people"], color="C4", label="parameter uncertainty" if row == 0 else None
    )
left.set_yticks([0, 1], list(shares))
left.set(
    xlabel="fraction of the variance of the mean force", title="More fingers reduce the second part", ylim=(-0.6, 2.1)
)
left.legend(ncols=2, loc="upper center")
for row, share in enumerate(people.shares["force_mean"].values()):
    right.barh(
        row - 0.2, share["first"], height=0.38, color="C0", label="first-order Sobol index" if row == 0 else None
    )
    right.barh(row + 0.2, share["total"], height=0.38, color="C1", label="total Sobol index" if row == 0 else None)
right.set_yticks(range(3), list(people.shares["force_mean"]))
right.set(xlabel="fraction of the variance of the mean force", title="Variance of the force by parameter")
right.invert_yaxis()
right.legend(loc="lower right")
plt.show()
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
figure, here = plt.subplots(figsize=(7.5, 4))
for name in ("sine", "triangle", "square"):
    curve = design.curve(name)
    (line,) = here.semilogx(curve["peak_to_peak"], 100 * curve["q50"], label=name)
    here.fill_between(curve["peak_to_peak"], 100 * curve["q05"], 100 * curve["q95"], alpha=0.15, color=line.get_color())
here.axhline(95, color="0.5", ls="--")
here.set_xticks([100, 200, 500, 1000, 2000], ["100", "200", "500", "1000", "2000"])
here.minorticks_off()
here.set(
    xlabel="drive (V, peak to peak)",
    ylabel="people who feel it (%)",
    title="Bands: 90 % credible, population parameters",
)
here.legend()
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
