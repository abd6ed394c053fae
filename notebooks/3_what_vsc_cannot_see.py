# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What does the skin voltage not determine, and which measurement does?
#
# There are three unknowns, Rsc, Csc and Ci, but H(s) = g b s / (1 + b s) has two parameters. So Vsc alone, however long
# the record, leaves one combination undetermined.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

import fitact

jax.config.update("jax_enable_x64", True)
plt.style.use("style.mplstyle")

# %% [markdown]
# ## The unidentified direction
#
# A contact k times as large has Rsc / k, k Csc and k Ci. The current and the force are k times as large, and Vsc is the
# same:

# %%
square = fitact.Square(peak_to_peak=360.0, frequency=100.0)
time = np.linspace(0.0, 10e-3, 1001)[:-1]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4))
seen = {}
for k, style in ((0.5, "-"), (1.0, "--"), (2.0, ":")):
    # 500 ohm in the loop, because otherwise the current has an impulse at each edge
    circuit = fitact.DirectGround(Rsc=160e3 / k, Csc=22e-9 * k, Ci=1.35e-9 * k, R_H=500.0 / k)
    seen[k] = np.asarray(fitact.response(circuit, square, time))
    current = np.asarray(fitact.response(circuit, square, time, channel="I"))
    left.plot(1e3 * time, seen[k], style, lw=2, label=f"contact x {k:g}")
    right.plot(1e3 * time[5:500], 1e6 * current[5:500], style, lw=2)
left.set(xlabel="time (ms)", ylabel="Vsc (V)", title="Skin voltage: the same for three contacts", ylim=(-17, 25))
left.legend(ncols=3, fontsize=9, loc="upper center")
right.set(xlabel="time (ms)", ylabel="I (µA)", title="The current differs")
plt.show()
print(f"largest difference of Vsc: {max(np.max(np.abs(v - seen[1.0])) for v in seen.values()):.1e} V")
assert all(np.allclose(v, seen[1.0], rtol=0, atol=1e-9) for v in seen.values())

# %% [markdown]
# ## The role of the prior
#
# Suppose that the prior is uniform: Rsc between 80 and 200 kΩ, and wide ranges for Csc and Ci. With g and b known, Ci =
# g b / Rsc and Csc = (1 − 2 g) b / Rsc. So along the unidentified direction a uniform box in (Rsc, Csc, Ci) has the
# density
#
# $$p(R_{sc}) \propto \left|\frac{\partial(C_{sc}, C_i)}{\partial(g, b)}\right| \propto \frac{1}{R_{sc}^2}$$
#
# This density prefers 80 kΩ sixfold over 200 kΩ, which nobody intended. A prior that is flat in Rsc becomes flat in the
# contact area, and so in the force. The closed form also tests the sampler: the 5, 50 and 95 % quantiles are 82, 114
# and 186 kΩ.


# %%
def measure(scene: fitact.Scene, seed: int) -> fitact.Record:
    """Simulate a record of the scene's circuit with its noise."""
    measured = scene.measurement
    time = np.arange(round(measured.duration * measured.sampling_rate)) / measured.sampling_rate
    circuit, drive = scene.make_circuit(), scene.make_drive()
    random, noise = np.random.default_rng(seed), {"Vsc": measured.noise_Vsc, "I": measured.noise_I}
    channels = {"V": np.asarray(drive.value(time))}
    for name in measured.channels:
        clean = np.asarray(fitact.response(circuit, drive, time, channel=name))
        channels[name] = clean + noise[name] * random.standard_normal(time.size)
    return fitact.Record.from_arrays(time, **channels)


box = {
    "Rsc": {"low": "80 kohm", "high": "200 kohm"},
    "Csc": {"low": "8.85 nF", "high": "100 nF"},
    "Ci": {"low": "0.3 nF", "high": "10 nF"},
}
boxed = fitact.Scene.from_dict({"prior": box})
fit = fitact.fit(measure(boxed, seed=1), boxed)
posterior = fitact.sample(fit, seed=1, progress=False)
print(posterior.convergence)
assert posterior.convergence.converged

# %%
low, high = 80e3, 200e3
drawn = np.sort(posterior.parameters()["Rsc"].ravel())
cdf = (1 / low - 1 / drawn) / (1 / low - 1 / high)  # cumulative distribution of the density 1 / Rsc^2
distance = np.max(np.abs(cdf - (np.arange(drawn.size) + 0.5) / drawn.size))
quantiles = np.quantile(drawn, [0.05, 0.5, 0.95])
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
left.hist(1e-3 * drawn, bins=40, density=True, alpha=0.6, label="draws")
shown = np.linspace(low, high, 200)
left.plot(1e-3 * shown, 1e3 / shown**2 / (1 / low - 1 / high), color="C1", lw=2, label="1 / Rsc², closed form")
left.set(xlabel="Rsc (kΩ)", ylabel="density (1/kΩ)", title="Uniform priors, Vsc alone")
left.legend()
force = posterior.force()["force_mean"]
ratio = force / np.median(force)
right.hist(ratio.ravel(), bins=40, density=True, alpha=0.6, color="C2")
right.set(xlabel="mean force over its median", ylabel="density", title="The resulting prior on the force")
plt.show()
print("quantiles:", ", ".join(f"{1e-3 * q:.0f} kΩ" for q in quantiles), f"; Kolmogorov distance {distance:.4f}")
assert np.allclose(1e-3 * quantiles, [82.5, 114.3, 186.0], rtol=0.015)
assert distance < 0.025  # 10,000 draws give 0.009 on average

# %% [markdown]
# ## More data of the same kind do not help
#
# From here on the prior is log-normal: Ci ± 5 %, Rsc and Csc ± 30 %. (No data sheet states Ci, which contains the
# contact area; ± 5 % needs a good picture of the footprint.) Records of the same finger, up to a hundred times as many
# samples:

# %%
prior = {
    "Rsc": {"median": "160 kohm", "relative_sd": 0.3},
    "Csc": {"median": "22 nF", "relative_sd": 0.3},
    "Ci": {"median": "1.35 nF", "relative_sd": 0.05},
}
counts = [400, 4_000, 40_000]
errors = {name: [] for name in ("g", "b", "Rsc", "force_mean")}
for count in counts:
    scene = fitact.Scene.from_dict(
        {"prior": prior, "measurement": {"sampling_rate": count / 20e-3, "duration": "20 ms"}}
    )
    fit = fitact.fit(measure(scene, seed=2), scene)
    for name, found in (fit.parameters() | fit.derived()).items():
        if name in errors:
            errors[name].append(found["sd"] / found["mean"])
figure, here = plt.subplots(figsize=(6, 3.8))
for (name, sds), marker in zip(errors.items(), "osv^", strict=True):
    here.loglog(counts, 100 * np.array(sds), marker + "-", label=name)
here.set(
    xlabel="samples",
    ylabel="standard deviation (%)",
    title="Errors of g and b shrink; those of Rsc and the force do not",
)
here.legend()
plt.show()
eigenvalues = fit.identifiability.eigenvalues
print(f"prior-whitened Fisher eigenvalues at {counts[-1]:,} samples:", ", ".join(f"{x:.3f}" for x in eigenvalues))
assert errors["g"][0] / errors["g"][-1] > 7  # sqrt(100) = 10
assert errors["force_mean"][-1] > 0.9 * errors["force_mean"][0]
assert eigenvalues[0] < 1e-3
assert eigenvalues[1] > 0.99
fit.plot_identifiability()
plt.show()

# %% [markdown]
# The smallest eigenvalue, 0, belongs to the unidentified direction: there the posterior equals the prior, and the error
# of the force stays at the 5 % of Ci. The posterior is a line, as long as the prior.
#
# ## Which measurement helps
#
# `fitact design measurement`, or `fitact.design_measurement`, gives the expected error of the force after each of
# several changes, before anything is measured.

# %%
scene = fitact.Scene.from_dict({"prior": prior})
design = fitact.design_measurement(scene)
design.plot()
plt.show()
design

# %% [markdown]
# To check these predictions, six fingers drawn from the prior are measured in three ways and fitted, and the results
# compared with the truth. Bars are the standard deviations of the fits.

# %%
changes = {
    "Vsc alone": {},
    "100 kΩ in series": {"series_resistor": "100 kohm"},
    "100 kΩ in series, and I": {"series_resistor": "100 kohm", "channels": ["Vsc", "I"]},
}
random = np.random.default_rng(3)
fingers = [np.exp(np.array([0.3, 0.3, 0.05]) * random.standard_normal(3)) * [160e3, 22e-9, 1.35e-9] for _ in range(6)]
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4))
widths = []
for (name, change), here in zip(changes.items(), axes, strict=True):
    off, sd = [], []
    for number, (Rsc, Csc, Ci) in enumerate(fingers):
        true = {"device": {"Ci": Ci}, "skin": {"Rsc": Rsc, "Csc": Csc}, "measurement": change}
        record = measure(fitact.Scene.from_dict(true), seed=number)
        found = fitact.fit(record, fitact.Scene.from_dict({"prior": prior, "measurement": change})).parameters()["Ci"]
        off.append(100 * (found["q50"] / Ci - 1))
        sd.append(100 * found["sd"] / found["mean"])
    here.errorbar(range(1, 7), off, sd, fmt="o", capsize=3)
    here.axhline(0, color="0.5", lw=1)
    here.set(xlabel="finger", ylabel="Ci, fit − truth (%)", title=f"{name}: ± {np.median(sd):.2g} %")
    widths.append(np.median(sd))
    assert np.all(np.abs(np.array(off) / sd) < 4)
plt.show()
assert widths[1] < 0.1 * widths[0]
assert widths[2] < 0.1 * widths[1]

# %% [markdown]
# The scales differ: each step to the right is more than ten times as precise. The resistor helps because it does not
# depend on the contact, so the time constant of the edges has a known scale.

# %% [markdown]
# ## What to take away
#
# - Vsc determines g and b, but not the contact area. Fingers whose contact areas differ fourfold can have the same Vsc.
# - So the force from Vsc alone is as uncertain as the prior on Ci. Uniform priors are not neutral: they prefer small
#   resistances by 1 / Rsc².
# - A longer record does not help. A known resistor in series or the current does; `fitact design measurement` gives the
#   expected error before you measure.
