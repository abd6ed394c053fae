# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What force will the next person feel, and which drive makes nearly everybody feel it?
#
# A panel is built for people whose skins differ. Eight fingers were recorded on one panel (synthetic records, made by
# ngspice; the truth is known). They are to tell how people are distributed, not only what these eight are.

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
# ## The law that fingers follow
#
# log Rsc and log Csc are normal over people, with a correlation; the panel's Ci is common to all. emcee samples the
# law; what is each finger's own is integrated out.

# %%
people = fitact.population(records, scene, seed=1, progress=False)
assert people.trusted
print(people)

# %%
new = people.new_fingers()
every = np.random.default_rng(0).choice(new["Rsc"].size, 4000, replace=False)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2))
left.loglog(
    1e-3 * new["Rsc"].ravel()[every], 1e9 * new["Csc"].ravel()[every], ".", ms=2, alpha=0.3, label="people to come"
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
right.set(xscale="log", xlabel="mean force (µN)", ylabel="draws", title="The force of the next finger")
low, high = np.quantile(force, [0.05, 0.95])
for edge, where, share in ((low, "right", "5 %"), (high, "left", "95 %")):
    right.axvline(edge, color="k", ls="--", lw=1)
    right.text(edge, 0.97, f"  {share}: {edge:.0f} µN  ", ha=where, va="top", transform=right.get_xaxis_transform())
plt.show()
logs = np.log([[x["Rsc"], x["Csc"]] for x in truth])
draws = people.parameters()
for name, spread in zip(("Rsc", "Csc"), logs.std(axis=0, ddof=1), strict=True):
    inside = np.quantile(draws[f"log_sd_{name}"], [0.01, 0.99])
    print(f"log sd of {name}: the eight's own {spread:.2f}, the law's {inside[0]:.2f} to {inside[1]:.2f} (98 %)")
    assert inside[0] < spread < inside[1]
assert high / low > 4

# %% [markdown]
# ## People, or ignorance?
#
# The spread has two parts. People differ, which no measurement changes; and eight fingers do not tell the law
# exactly, which more fingers would. With the first three fingers alone:

# %%
three = fitact.population(records[:3], scene, seed=1, progress=False)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4))
shares = {}
for row, (name, found) in enumerate({"3 fingers": three, "8 fingers": people}.items()):
    part = found.to_dict()["new_finger"]["force_mean"]["variance"]
    shares[name] = part["people"]
    left.barh(row, part["people"], color="C0", label="people" if row == 0 else None)
    left.barh(row, part["ignorance"], left=part["people"], color="C4", label="ignorance" if row == 0 else None)
left.set_yticks([0, 1], list(shares))
left.set(xlabel="share of the variance of the mean force", title="What more fingers would take away", ylim=(-0.6, 2.1))
left.legend(ncols=2, loc="upper center")
for row, share in enumerate(people.shares["force_mean"].values()):
    right.barh(row - 0.2, share["first"], height=0.38, color="C0", label="gone once it is known" if row == 0 else None)
    right.barh(row + 0.2, share["total"], height=0.38, color="C1", label="left if only it is not" if row == 0 else None)
right.set_yticks(range(3), list(people.shares["force_mean"]))
right.set(xlabel="share of the variance of the mean force", title="Which parameter makes the force differ")
right.invert_yaxis()
right.legend(loc="lower right")
plt.show()
print(", ".join(f"{name}: {100 * share:.0f} % people" for name, share in shares.items()))
assert shares["8 fingers"] > shares["3 fingers"]
assert people.shares["force_mean"]["Csc"]["first"] > 0.5

# %% [markdown]
# It is the skin's capacitance: the divider g = Ci / (2 Ci + Csc) sets how much of each jump the skin gets.

# %% [markdown]
# ## A drive that 95 % of people feel
#
# What counts as felt is stated, not known by this package; here 0.1 mN of alternating force, for the sake of the
# example. `fitact design drive` does the same, and checks limits of breakdown and current.

# %%
asked = fitact.Scene.from_dict(
    {
        "drive": {"waveform": "trapezoid", "rise_time": "50 us"},
        "perception": {"threshold_force": "0.1 mN"},
    }
)
design = fitact.design_drive(asked, people, share=0.95)
figure, here = plt.subplots(figsize=(7.5, 4))
for name in ("sine", "triangle", "square"):
    curve = design.curve(name)
    (line,) = here.semilogx(curve["peak_to_peak"], 100 * curve["q50"], label=name)
    here.fill_between(curve["peak_to_peak"], 100 * curve["q05"], 100 * curve["q95"], alpha=0.15, color=line.get_color())
here.axhline(95, color="0.5", ls="--")
here.set_xticks([100, 200, 500, 1000, 2000], ["100", "200", "500", "1000", "2000"])
here.minorticks_off()
here.set(
    xlabel="drive (V, peak to peak)", ylabel="people who feel it (%)", title="Bands: what is not known of people, 90 %"
)
here.legend()
plt.show()
half = {name: np.median(needed) for name, needed in design.needed.items()}
nearly_all = {name: option.assured for name, option in design.options.items()}
for name, volts in nearly_all.items():
    print(f"{name:10} half: {half[name]:.0f} V; 95 %, met with 95 % probability: {volts:.0f} V peak to peak")
assert half["square"] < 0.8 * half["sine"]
assert nearly_all["square"] / half["square"] > 1.2 * nearly_all["sine"] / half["sine"]

# %% [markdown]
# Half of the people feel the square first. To be sure of nearly all, it has lost that lead, and needs about what the
# sine does: where Rsc Csc is large, Vsc hardly decays between the edges, so a square presses steadily, and what is
# steady is not felt.

# %% [markdown]
# ## What to take away
#
# - The next finger's force is uncertain severalfold, however well each finger is measured: people differ.
# - How much of that is people and how much is ignorance is part of the answer. More fingers reduce the second only.
# - Mostly Csc makes the force differ, by the divider g.
# - Which waveform is best depends on whom it is for: a square for most; for nearly all it has no lead over a sine.
