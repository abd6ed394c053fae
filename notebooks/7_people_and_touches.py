# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Do people differ more than touches do, and which drive do 90 % of people feel in 9 of 10 touches?
#
# Six people put a finger on a panel three times each: 18 records of V, Vsc and I, simulated with noise, rounding to 12
# bits and skew in every channel, so the truth is known. Three touches of a person are not three people: the table of
# the experiment says which record is whose. Forces are computed with eq. (22) of the reference paper; none is measured.

# %%
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fitact

plt.style.use("style.mplstyle")
FOLDER = Path("../data_synth/records/study")
study = fitact.Study.from_table(FOLDER / "study.csv")
scene = fitact.Scene.load(FOLDER.with_suffix(".toml"))
true_values = json.loads((FOLDER / "truth.json").read_text())
truth = np.log([[each[name] for name in ("Rsc", "Csc", "Ci")] for each in true_values])
print(study)

# %% [markdown]
# ## The population
#
# log Rsc, log Csc and log contact area of a touch are a median plus a person's effect plus the touch's own. The effects
# are integrated out in closed form; what is sampled are the medians and the standard deviations of both levels.

# %%
people = fitact.population(study, scene, seed=1, progress=False)
assert people.trusted
people.plot()
plt.show()

# %% [markdown]
# ## Do people differ more than touches do?
#
# The variance of the touches that were drawn, by an analysis of variance of the true values, against the estimates:

# %%
content = people.to_dict()
by_person = truth.reshape(6, 3, 3)
within = by_person.var(axis=1, ddof=1).mean(axis=0)
between = by_person.mean(axis=1).var(axis=0, ddof=1) - within / 3
for level, true in zip(content["levels"], (between, within), strict=True):
    for i, name in enumerate(("Rsc", "Csc")):
        found = level["log_sd"][name]
        sd, low, high = np.sqrt(true[i]), found["q025"], found["q975"]
        print(f"log sd of {name}, {level['level']}: {sd:.3f}, found {low:.3f} to {high:.3f}")
        assert low < sd < high
repeats = content["levels"][0]["intraclass_correlation"]["force_mean"]
print(f"correlation of the force of two touches of a person: {repeats['q05']:.2f} to {repeats['q95']:.2f} (90 %)")
assert repeats["q05"] > 0.7

# %% [markdown]
# People differ more: the touches of a person have nearly the same force. The contact area is the exception, since it
# changes from touch to touch as much as between people. Taken as 18 people, the same records would promise medians
# that are known almost twice as well as they are:

# %%
eighteen = fitact.population(fitact.Study(study.records, {}, {}, {}, ""), scene, seed=1, progress=False)
widths = {
    name: np.ptp(np.quantile(np.log(found.parameters()["Rsc"]), [0.025, 0.975]))
    for name, found in (("6 people", people), ("18 people", eighteen))
}
print(", ".join(f"{name}: 95 % interval of log Rsc's median {width:.2f}" for name, width in widths.items()))
assert widths["6 people"] > 1.4 * widths["18 people"]

# %% [markdown]
# More repetitions would hardly help; more people would:

# %%
for each in content["next_studies"]:
    print(
        f"{each['units']:3} people x {each['repetitions']:2}: median force to {100 * each['median_u']:.0f} %,"
        f" its spread between people to {100 * each['log_sd_u']:.0f} %"
    )
now, twice_the_touches, _, twice_the_people, *_ = content["next_studies"]
assert twice_the_people["median_u"] < 0.8 * now["median_u"] < twice_the_touches["median_u"]

# %% [markdown]
# ## The next touch
#
# Of a person who was recorded, much is known; of a new one, little:

# %%
for name, values in content["forecasts"].items():
    force = values["force_mean"]
    what = "a new person, typically" if name == "person" else f"{name}, next touch"
    print(f"{what:24} {1e6 * force['q05']:4.0f} to {1e6 * force['q95']:4.0f} µN (90 %)")
new, known = content["new_finger"]["force_mean"], content["forecasts"]["P1"]["force_mean"]
assert np.log(new["q95"] / new["q05"]) > 2 * np.log(known["q95"] / known["q05"])

# %% [markdown]
# ## A drive that 90 % of people feel in 9 of 10 touches
#
# The threshold is an example, because fitact knows no valid one. `fitact design drive felt.toml people --share 0.9
# --touches 0.9` does the same from the folder that `fitact population --out people` left.

# %%
panel = fitact.Scene.from_dict({"perception": {"threshold_force": "20 uN"}, "drive": {"waveform": "sine"}})
design = fitact.design_drive(panel, people, 0.9, touches=0.9)
print(design.recommendation)
assert design.trusted

# %% [markdown]
# ## What to take away
#
# - A table of the experiment (or a pattern of file names) keeps touches and people apart.
# - Repetitions tell how well a person repeats. Only more people tell how people differ.
# - The next touch of a known person can be forecast several times better than that of a stranger.
