# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What are this finger's Rsc and Csc, how strong is the force, and how sure am I?
#
# From an oscilloscope's file to a report. The file here is written in the layout of a Tektronix MSO from a record
# that ships with the project, as a lab would have got it: V on CH1, and on CH2 the skin voltage behind a 10x probe
# that the oscilloscope took for 1x. Put the path of your own in its place.

# %%
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fitact

plt.style.use("style.mplstyle")
RECORDS = Path("../data_synth/records")
folder = Path("../out/notebooks")
folder.mkdir(parents=True, exist_ok=True)
table = np.loadtxt(RECORDS / "finger_direct.csv", delimiter=",", skiprows=1)
header = f"""Model,MSO58
Waveform Type,ANALOG,ANALOG
Horizontal Units,s,s
Sample Interval,5e-06,5e-06
Record Length,{len(table)},{len(table)}
Vertical Units,V,V
Probe Attenuation,100,1

TIME,CH1,CH2"""
captured = folder / "tek0001.csv"
np.savetxt(captured, table * [1.0, 1.0, 0.1], fmt="%.7g", delimiter=",", header=header, comments="")

# %% [markdown]
# ## Look before you fit
#
# `fitact inspect FILE`, or `fitact.inspect`, shows what a file holds. Which channel is which is never guessed. Once
# it is told, it finds the probe's factor missing; with `scale` it has nothing left to say.

# %%
channels = {"V": "CH1", "Vsc": "CH2"}
print(fitact.inspect(captured), "\n")
seen = fitact.inspect(captured, channels=channels)
print(*seen.warnings, sep="\n")
assert any("10x probe" in warning for warning in seen.warnings)
assert not fitact.inspect(captured, channels=channels, scale={"Vsc": 10}).warnings

# %% [markdown]
# ## What is known beforehand
#
# A scene says what you know of the device; what is absent is the paper's nominal one. Ci from the panel's data sheet,
# to 5 %, is the one thing stated here; the skin's priors are wide. The drive is taken as recorded, since its edges
# are not ideal.

# %%
scene = fitact.Scene.from_dict(
    {
        "device": {"Ci": "1.35 nF"},
        "drive": {"waveform": "measured"},
        "prior": {"Ci": {"median": "1.35 nF", "relative_sd": 0.05}},
    }
)
record = fitact.read(captured, scene, channels=channels, scale={"Vsc": 10})
print(*record.notes, sep="\n")

# %% [markdown]
# ## Fit

# %%
fit = fitact.fit(record, scene)
print(fit)
assert fit.trusted
assert fit.identifiability.verdict == "prior-limited"

# %% [markdown]
# The verdict matters more than the numbers: "prior-limited". The record fixes the divider g and the time constant b
# to a few parts in ten thousand and says nothing of the contact area, so Rsc, Csc and the force are as uncertain as
# Ci was before. The residuals below are noise, with no structure left at the edges: the circuit holds.

# %%
figure, (above, below) = plt.subplots(2, 1, figsize=(9, 4.6), sharex=True, height_ratios=[2, 1])
above.plot(1e3 * record.time, record["Vsc"], ".", ms=2, color="#333333", label="record")
above.plot(1e3 * record.time, record["Vsc"] - fit.residuals, lw=1, label="fit")
below.plot(1e3 * record.time, fit.residuals, ".", ms=2, color="C1")
above.set(ylabel="Vsc (V)", title="The record and the fit")
above.legend(ncols=2, loc="upper right", markerscale=4)
above.set_ylim(-18, 22)
below.set(xlabel="time (ms)", ylabel="record − fit (V)")
plt.show()

# %% [markdown]
# ## Sample
#
# emcee, until it has converged, which is judged by its autocorrelation time and by split-R-hat over independent
# ensembles.

# %%
posterior = fitact.sample(fit, seed=1, progress=False)
print(posterior.convergence)
assert posterior.trusted

# %%
draws, force = posterior.parameters(), posterior.force()
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
every = slice(None, None, 5)
for here, name, scale, unit in ((axes[0], "Rsc", 1e-3, "kΩ"), (axes[1], "Csc", 1e9, "nF")):
    here.plot(1e9 * draws["Ci"].ravel()[every], scale * draws[name].ravel()[every], ".", ms=1)
    here.set(xlabel="Ci (nF)", ylabel=f"{name} ({unit})", title=f"{name} and Ci: one line is left open")
axes[2].hist(1e6 * force["force_mean"].ravel(), bins=40, color="C2")
axes[2].set(xlabel="mean force (µN)", ylabel="draws", title="Mean force")
plt.show()

# %%
quantities = draws | posterior.derived()
spread = {name: np.std(np.log(quantities[name])) for name in ("Rsc", "Csc", "Ci", "force_mean", "g", "b")}
for name, sd in spread.items():
    print(f"{name:12} ± {100 * sd:.2g} %")
assert max(spread["g"], spread["b"]) < 1e-3
assert all(0.03 < spread[name] < 0.07 for name in ("Rsc", "Csc", "Ci", "force_mean"))

# %% [markdown]
# The record is synthetic, so the truth is known. All of it lies within two posterior standard deviations:

# %%
truth = json.loads((RECORDS / "finger_direct.json").read_text())["truth"]
for name in ("Rsc", "Csc", "Ci"):
    off = (np.log(truth[name]["value"]) - np.mean(np.log(draws[name]))) / spread[name]
    print(f"{name}: {off:+.2f} sd")
    assert abs(off) < 2

# %% [markdown]
# ## Report
#
# One file with everything: verdict, numbers, pictures, how it was computed. It opens offline. `fitact run FILE
# --channel V=CH1 --channel Vsc=CH2 --scale Vsc=10 --scene scene.toml --out results` does all of this page in one
# command.

# %%
page = folder / "report.html"
posterior.report(page)
posterior.to_netcdf(folder / "posterior.nc")
for made in (page, folder / "posterior.nc"):
    print(f"{made.name}: {made.stat().st_size / 1e6:.1f} MB")
assert page.stat().st_size < 5e6

# %% [markdown]
# ## What to take away
#
# - Inspect first: a probe's factor, swapped channels or clipping are seen there, and no fit can repair them.
# - g and b are the record's; Rsc, Csc, Ci and the force inherit the width of the prior on Ci.
# - More of the same data will not help. The current, a known series resistor or a better Ci will: [the next
#   notebook](3_what_vsc_cannot_see.ipynb) shows why.
