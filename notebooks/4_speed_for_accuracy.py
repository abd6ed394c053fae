# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What does accuracy cost, and where may I save?
#
# Three things can be computed at several levels: the response of the circuit, the likelihood of a record, and the
# uncertainty. Each is measured here on the shipped record or its drive, against the best reference. Levels take
# turns, so that the ratios hold where the times depend on the machine. `fitact tradeoff RECORD` measures more of them
# on your own record, in a minute or two.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.integrate

import fitact

jax.config.update("jax_enable_x64", True)
plt.style.use("style.mplstyle")


def timed(jobs: dict) -> dict:
    """Seconds of a call of each job: the quickest of many turns, which other programs disturb least."""
    taken = {name: [] for name in jobs}
    for _ in range(20):
        for name, job in jobs.items():
            began, calls = time.perf_counter(), 0
            while time.perf_counter() - began < 3e-3:
                job()
                calls += 1
            taken[name].append((time.perf_counter() - began) / calls)
    return {name: min(seconds) for name, seconds in taken.items()}


# %% [markdown]
# ## The response
#
# Every circuit of this package is a gain and a few first-order low-passes, whose response to a square has a closed
# form. The usual ways around that are a sum of harmonics, an ODE solver, and single precision.

# %%
circuit = fitact.FinalCircuit(Rsc=160e3, Csc=22e-9, Ci=1.35e-9)
square = fitact.Square(peak_to_peak=360.0, frequency=100.0)
times = (np.arange(4000) + 0.5) / 400e3  # one period, beside the edges
g, b = float(circuit.g), float(circuit.b)


def compiled(function):
    """The function of the times, compiled, as a job that gives its values."""
    at = jnp.asarray(times)
    program = jax.jit(function).lower(at).compile()
    return lambda: np.asarray(program(at))


def ode() -> np.ndarray:
    """scipy's LSODA from edge to edge, from rest until ten periods have passed: the last of them."""
    low, halves, inside = 0.0, [], times[times < 5e-3]
    for number in range(20):
        high = 180.0 * (-1) ** number
        settings = {"method": "LSODA", "t_eval": np.append(inside, 5e-3), "rtol": 1e-6, "atol": 1e-4}
        found = scipy.integrate.solve_ivp(lambda t, x, high=high: (high - x) / b, (0.0, 5e-3), [low], **settings)
        low = found.y[0, -1]
        halves.append(g * (high - found.y[0, :-1]))
    return np.concatenate(halves[-2:])


levels = {"exact": compiled(lambda t: fitact.response(circuit, square, t))}
for n in (10, 100, 1000):
    levels[f"{n} harmonics"] = compiled(lambda t, n=n: fitact.harmonic_response(circuit, square, t, n))
with jax.enable_x64(False):
    levels["float32"] = compiled(lambda t: fitact.response(circuit, square, t))
levels["ODE (scipy)"] = ode

# %%
exact = 360.0 * g / (1 + np.exp(-5e-3 / b)) * np.exp(-(times % 5e-3) / b) * np.where(times < 5e-3, 1.0, -1.0)


def off(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean((values - exact) ** 2) / np.mean(exact**2)))


errors = {name: max(off(job()), 1e-16) for name, job in levels.items()}
seconds = timed(levels)
ratios = {name: seconds[name] / seconds["exact"] for name in levels}


def drawn(here, name: str, x: float, y: float) -> None:
    """A point with its name."""
    here.loglog(x, y, "o", ms=8)
    here.annotate(name, (x, y), va="center", xytext=(8, 0), textcoords="offset points")


figure, here = plt.subplots(figsize=(7, 4))
for name, ratio in ratios.items():
    drawn(here, name, ratio, errors[name])
    print(f"{name:15} error {errors[name]:.1e}, time {ratio:.3g} times that of the exact one")
here.set(
    xlabel="time over that of the exact response", ylabel="relative rms error of Vsc", title="Response to a square"
)
here.set_xlim(right=10 * max(ratios.values()))
plt.show()
assert errors["exact"] < 1e-13
assert errors["1000 harmonics"] > 1e-3
assert ratios["100 harmonics"] > 2
assert ratios["1000 harmonics"] > 10

# %% [markdown]
# There is nothing to trade: the exact response is the most accurate and, give or take a factor that single precision
# may save, the fastest. A square has harmonics without end, so a sum of them is slow and never good at the edges.
# (Under a sine one harmonic is exact.) Single precision is good enough to draw with; fits need more than its seven
# digits.

# %% [markdown]
# ## Likelihood and uncertainty
#
# A record's likelihood depends on its samples through a few projections only: its compressed form takes those once
# and never looks at the samples again. And the posterior can be had as a Gaussian (Laplace), as importance-weighted
# draws from it (psis), or sampled by emcee. The reference is emcee on the sum over all samples.

# %%
scene = fitact.Scene.load("../data_synth/records/finger_direct.toml")
record = fitact.read("../data_synth/records/finger_direct.csv", scene)
full, compressed = fitact.fit(record, scene, tolerance=0.0), fitact.fit(record, scene)
print(f"{len(record):,} samples; the compressed log-likelihood is off by {compressed.compression_error:.0e} at most")

ways = {
    "emcee, all samples": (full, "emcee"),
    "emcee, compressed": (compressed, "emcee"),
    "psis, compressed": (compressed, "psis"),
    "laplace, compressed": (compressed, "laplace"),
}
runs = {}
for name, (fit, level) in ways.items():
    for seed in (0,) if fit is full else (0, 1):  # the first compiles, which is little beside all samples' time
        runs[name] = fitact.sample(fit, level=level, seed=seed, progress=False)


# %%
def moments(posterior) -> np.ndarray:
    """Mean, sd and quantiles of log Rsc and of the log of the mean force."""
    logs = [np.log(posterior.parameters()["Rsc"]).ravel(), np.log(posterior.force()["force_mean"]).ravel()]
    return np.array([[x.mean(), x.std(), *np.quantile(x, [0.05, 0.5, 0.95])] for x in logs])


reference = moments(runs["emcee, all samples"])
reference_draws = runs["emcee, all samples"].log_prob.size
off_by = {name: np.max(np.abs(moments(run) - reference) / reference[:, 1:2]) for name, run in runs.items()}
each = {name: run.convergence.seconds / run.convergence.ess["force_mean"] for name, run in runs.items()}
cost = {name: each[name] / each["emcee, all samples"] for name in ways}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 2.6), sharey=True)
left.barh(list(ways), cost.values())
left.set(xscale="log", xlim=(0.01, 2), xlabel="time of an effective draw", title="Cost, over that of the first")
right.barh(list(ways), off_by.values(), color="C1")
# the sd of a 5 % quantile is 2.11 sd / sqrt(draws); the largest of ten differences is hardly ever above 2.5 of those
resolution = 2.5 * 2.11 * np.sqrt(2 / reference_draws)
right.axvspan(0, resolution, color="0.9", zorder=0)
right.text(0.97 * resolution, 0, "grey: not told from 0\nby so many draws", ha="right", va="center")
right.set(xlim=(0, 0.1), xlabel="largest error (posterior sd)", title="Mean, sd and quantiles of Rsc and force")
left.invert_yaxis()
plt.show()
for name in ways:
    print(f"{name:20} off by {off_by[name]:.3f} sd, time {cost[name]:.2g} for each effective draw")
assert max(off_by.values()) < resolution
assert cost["emcee, compressed"] < 0.3

# %% [markdown]
# All answers agree here, since this posterior is nearly Gaussian in the logarithms: Laplace says so itself, by its
# own weights, and refuses where it is not. What costs is the sum over samples, and it grows with the record; the
# compressed form does not.

# %% [markdown]
# ## The model: what may be left out
#
# `fitact.plan(scene)` takes what a scene names (here the body's resistance R_H, another grounding finger, a probe,
# edges of 20 µs), leaves out one after the other, and chooses the cheapest combination that keeps the tolerance.

# %%
lab = fitact.Scene.from_dict(
    {
        "grounding": {"R_H": "500 ohm", "grounding_Rsc": "80 kohm", "grounding_Csc": "30 nF"},
        "drive": {"waveform": "trapezoid", "rise_time": "20 us"},
        "measurement": {"probe_resistance": "10 Mohm", "probe_capacitance": "10 pF"},
        "tolerance": {"force": 0.01},
    }
)
plan = fitact.plan(lab)
figure, here = plt.subplots(figsize=(8, 3.2))
for row, omission in enumerate(plan.omissions):
    color = "C1" if omission.kept else "C2"
    nominal, wide = 100 * omission.nominal.force, 100 * omission.q95.force
    here.plot([nominal, wide], [row, row], "-", color=color)
    here.plot(nominal, row, "o", color=color)
    here.plot(wide, row, "|", ms=12, color=color)
    here.text(120, row, "kept" if omission.kept else "left out", va="center", color=color)
here.axvline(100 * lab.tolerance.force, ls="--", color="0.4")
here.set_yticks(range(len(plan.omissions)), [omission.name for omission in plan.omissions])
here.set(
    xscale="log", xlim=(5e-5, 1e3), xlabel="error of the force where it is left out (%); |: 95 % of the prior are below"
)
here.margins(y=0.12)
here.set_title("The plan, for a tolerance of 1 %")
plt.show()
for omission in plan.omissions:
    print(f"{omission.name:16} {omission.speedup:.2f} times faster without; {omission.because}")
assert plan.nominal.force <= 0.01
assert "grounding skin" not in plan.left_out

# %% [markdown]
# Some of the prior's fingers would not keep the tolerance without what the plan leaves out at the nominal values; the
# plan says so in its warning. A narrower prior or a smaller tolerance brings it back in.

# %%
print(plan.warnings[0])

# %% [markdown]
# ## What to take away
#
# - Response: take the exact one. Approximations are slower or worse, here both.
# - Likelihood: take the compressed one, which is the default; its error is certified, and far below anything that
#   matters.
# - Uncertainty: emcee on the compressed likelihood is cheap already. `laplace` suffices for a look, where its own
#   weights certify it.
# - Model: name everything that there is in the scene, and let the plan leave out what the tolerance does not need.
