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
# From an oscilloscope's file to a report. The record ships with the project and was simulated by ngspice; here it is
# written in the layout of a Tektronix MSO. V is on CH1. Vsc is on CH2, behind a 10x probe that the oscilloscope took
# for a 1x probe. Replace the path with your own.

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
# `fitact inspect FILE`, or `fitact.inspect`, lists the channels of a file. You assign them; fitact does not guess. It
# then finds that the probe's factor is missing, and with `scale` the warning is gone.

# %%
channels = {"V": "CH1", "Vsc": "CH2"}
print(fitact.inspect(captured), "\n")
seen = fitact.inspect(captured, channels=channels)
print(*seen.warnings, sep="\n")
assert any("10x probe" in warning for warning in seen.warnings)
assert not fitact.inspect(captured, channels=channels, scale={"Vsc": 10}).warnings

# %% [markdown]
# ## Prior knowledge
#
# A scene states what you know of the device; absent keys have the values of the reference paper's nominal device. Here
# it states Ci with 5 % uncertainty. Ci = eps A / Ti contains the contact area A of this finger under this load, so no
# data sheet states it. Take eps and Ti from the data sheet and A from a picture of the footprint; or record the loop
# current I, or add a known resistor in series, which determine Ci. The priors on the skin are wide. The fit uses the
# recorded drive, because its edges are not ideal.

# %%
scene = fitact.Scene.from_dict(
    {
        "device": {"contact_area": "39.1 mm^2", "insulator_thickness": "1 um", "insulator_permittivity": 3.9},
        "drive": {"waveform": "measured"},
        "prior": {"Ci": {"relative_sd": 0.05}},  # around eps A / Ti; mostly the uncertainty of the area
    }
)
record = fitact.read(captured, scene, channels=channels, scale={"Vsc": 10})
print(*record.notes, sep="\n")
record.plot()
plt.show()

# %% [markdown]
# ## Fit

# %%
fit = fitact.fit(record, scene)
assert fit.trusted
assert fit.identifiability.verdict == "prior-limited"
fit

# %% [markdown]
# The uncertainties are those that one would sign: "unstated gains" means that the scene does not state the instruments,
# so that usual errors are included. `print(fit.summary(verbose=True))` adds all other quantities, what noise alone
# allows, and what to measure next. The verdict matters more than the numbers: "prior-limited". Noise leaves a few parts
# in ten thousand on the divider g and the time constant b, but the data do not determine the contact area. The force is
# computed with eq. (22) of the reference paper; these data do not test that law. The residuals below are consistent
# with noise, also at the edges, so the circuit describes the record.

# %%
fit.plot()
plt.show()

# %% [markdown]
# ## Sample
#
# emcee runs until it has converged, by its autocorrelation time and by split-R-hat over independent ensembles.

# %%
posterior = fitact.sample(fit, seed=1, progress=False)
assert posterior.trusted
posterior

# %%
posterior.plot()
plt.show()

# %% [markdown]
# Vsc does not separate Ci from Rsc and Csc, so the posterior lies along a line in the last two pairs; unstated gains
# widen it. The force over time:

# %%
posterior.plot_force()
plt.show()

# %%
draws = posterior.parameters()
quantities = draws | posterior.derived()
spread = {name: np.std(np.log(quantities[name])) for name in ("Rsc", "Csc", "Ci", "force_mean", "g", "b")}
combined = posterior.combined_draws
print(f"{'':12} {'combined':>8}  noise and prior alone")
for name, sd in spread.items():
    print(f"{name:12} {100 * np.std(np.log(combined[name])):>6.2g} %  {100 * sd:.2g} %")
assert max(spread["g"], spread["b"]) < 1e-3
assert all(0.03 < spread[name] < 0.07 for name in ("Rsc", "Csc", "Ci", "force_mean"))

# %% [markdown]
# The record is simulated with exact instruments, so noise and prior alone must explain the distance from the true
# values. They lie within two standard deviations of the posterior:

# %%
truth = json.loads((RECORDS / "finger_direct.json").read_text())["truth"]
for name in ("Rsc", "Csc", "Ci"):
    off = (np.log(truth[name]["value"]) - np.mean(np.log(draws[name]))) / spread[name]
    print(f"{name}: {off:+.2f} sd")
    assert abs(off) < 2

# %% [markdown]
# ## Report
#
# One file holds verdict, numbers, pictures and the command, and opens offline. `fitact run FILE --channel V=CH1
# --channel Vsc=CH2 --scale Vsc=10 --scene scene.toml --out results` does all of this in one command.

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
# - Inspect first: it shows a missing probe factor, swapped channels or clipping, which no fit can repair.
# - The data determine g and b; Rsc, Csc, Ci and the force inherit the uncertainty of the prior on Ci.
# - More data of the same kind do not help. The current, a known series resistor or a better Ci do: [the next
#   notebook](3_what_vsc_cannot_see.ipynb) shows why.
# - The stated error of the force covers the circuit only, not the force law, the skin thickness or the calibration.
