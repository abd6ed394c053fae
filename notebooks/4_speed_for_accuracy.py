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
# The response of the circuit, the likelihood of a record and the posterior can each be computed by several methods.
# This notebook compares them on the shipped (simulated) record or its drive. Timings are interleaved, so their ratios
# depend little on the machine. `fitact tradeoff RECORD` compares more methods on your own record, in a minute or two.

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
    """Return the seconds per call of each job, as the minimum of many rounds, which other programs disturb least."""
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
# Every circuit of this package is a sum of a few first-order high-passes, whose response to a square has a closed
# form. Common alternatives are a sum of harmonics, an ODE solver, and single precision.

# %%
circuit = fitact.FinalCircuit(Rsc=160e3, Csc=22e-9, Ci=1.35e-9)
square = fitact.Square(peak_to_peak=360.0, frequency=100.0)
times = (np.arange(4000) + 0.5) / 400e3  # one period, no sample on an edge
g, b = float(circuit.g), float(circuit.b)


def compiled(function):
    """Compile a function of the times and return a job that evaluates it."""
    at = jnp.asarray(times)
    program = jax.jit(function).lower(at).compile()
    return lambda: np.asarray(program(at))


def ode() -> np.ndarray:
    """Return the tenth period from rest, by scipy's LSODA from edge to edge."""
    low, halves, inside = 0.0, [], times[times < 5e-3]
    for number in range(20):
        high = 180.0 * (-1) ** number
        settings = {"method": "LSODA", "t_eval": np.append(inside, 5e-3), "rtol": 1e-6, "atol": 1e-4}
        found = scipy.integrate.solve_ivp(lambda t, x, high=high: (high - x) / b, (0.0, 5e-3), [low], **settings)
        low = found.y[0, -1]
        halves.append(g * (high - found.y[0, :-1]))
    return np.concatenate(halves[-2:])


methods = {"exact": compiled(lambda t: fitact.response(circuit, square, t))}
for n in (10, 100, 1000):
    methods[f"{n} harmonics"] = compiled(lambda t, n=n: fitact.harmonic_response(circuit, square, t, n))
with jax.enable_x64(False):
    methods["float32"] = compiled(lambda t: fitact.response(circuit, square, t))
methods["ODE (scipy)"] = ode

# %%
exact = 360.0 * g / (1 + np.exp(-5e-3 / b)) * np.exp(-(times % 5e-3) / b) * np.where(times < 5e-3, 1.0, -1.0)


def off(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean((values - exact) ** 2) / np.mean(exact**2)))


errors = {name: max(off(job()), 1e-16) for name, job in methods.items()}
seconds = timed(methods)
ratios = {name: seconds[name] / seconds["exact"] for name in methods}


def drawn(here, name: str, x: float, y: float) -> None:
    """Draw a point with its name."""
    here.loglog(x, y, "o", ms=8)
    here.annotate(name, (x, y), va="center", xytext=(8, 0), textcoords="offset points")


figure, here = plt.subplots(figsize=(7, 4))
for name, ratio in ratios.items():
    drawn(here, name, ratio, errors[name])
    print(f"{name:15} error {errors[name]:.1e}, time {ratio:.3g} times the exact response's")
here.set(xlabel="time relative to the exact response", ylabel="relative rms error of Vsc", title="Response to a square")
here.set_xlim(right=10 * max(ratios.values()))
plt.show()
assert errors["exact"] < 1e-13
assert errors["1000 harmonics"] > 1e-3
assert ratios["100 harmonics"] > 2
assert ratios["1000 harmonics"] > 10

# %% [markdown]
# Nothing is gained by an approximation: the exact response is the most accurate and, apart from single precision, the
# fastest. A square has infinitely many harmonics, so their sum is slow and inaccurate at the edges. (For a sine, one
# harmonic is exact.) Single precision suffices for plots; fits need more than its seven digits.

# %% [markdown]
# ## Likelihood and posterior
#
# The likelihood depends on the samples only through a few projection coefficients. The compressed likelihood computes
# them once and does not use the samples again. The posterior can be approximated by a Gaussian (laplace), by
# importance-weighted draws (psis), or sampled by emcee. The reference is emcee on the sum over all samples.

# %%
scene = fitact.Scene.load("../data_synth/records/finger_direct.toml")
record = fitact.read("../data_synth/records/finger_direct.csv", scene)
full, compressed = fitact.fit(record, scene, tolerance=0.0), fitact.fit(record, scene)
print(f"{len(record):,} samples; error of the compressed log-likelihood at most {compressed.compression_error:.0e}")

ways = {
    "emcee, all samples": (full, "emcee"),
    "emcee, compressed": (compressed, "emcee"),
    "psis, compressed": (compressed, "psis"),
    "laplace, compressed": (compressed, "laplace"),
}
runs = {}
for name, (fit, level) in ways.items():
    for seed in (0,) if fit is full else (0, 1):  # the first run compiles, which hardly counts for all samples
        runs[name] = fitact.sample(fit, level=level, seed=seed, progress=False)


# %%
def moments(posterior) -> np.ndarray:
    """Return mean, sd and quantiles of log Rsc and of the log mean force."""
    logs = [np.log(posterior.parameters()["Rsc"]).ravel(), np.log(posterior.force()["force_mean"]).ravel()]
    return np.array([[x.mean(), x.std(), *np.quantile(x, [0.05, 0.5, 0.95])] for x in logs])


reference = moments(runs["emcee, all samples"])
reference_draws = runs["emcee, all samples"].log_prob.size
off_by = {name: np.max(np.abs(moments(run) - reference) / reference[:, 1:2]) for name, run in runs.items()}
each = {name: run.convergence.seconds / run.convergence.ess["force_mean"] for name, run in runs.items()}
cost = {name: each[name] / each["emcee, all samples"] for name in ways}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 2.6), sharey=True)
left.barh(list(ways), cost.values())
left.set(xscale="log", xlim=(0.01, 2), xlabel="time of an effective draw", title="Cost relative to the first")
right.barh(list(ways), off_by.values(), color="C1")
# the sd of a 5 % quantile is 2.11 sd / sqrt(draws); the largest of ten differences is hardly ever above 2.5 of those
resolution = 2.5 * 2.11 * np.sqrt(2 / reference_draws)
right.axvspan(0, resolution, color="0.9", zorder=0)
right.text(0.97 * resolution, 0, "grey: consistent with 0\nfor this number of draws", ha="right", va="center")
right.set(xlim=(0, 0.1), xlabel="largest error (posterior sd)", title="Mean, sd and quantiles of Rsc and force")
left.invert_yaxis()
plt.show()
for name in ways:
    print(f"{name:20} error {off_by[name]:.3f} sd, relative time {cost[name]:.2g} per effective draw")
assert max(off_by.values()) < resolution
assert cost["emcee, compressed"] < 0.3

# %% [markdown]
# All methods agree, because this posterior is nearly Gaussian in the logarithms. Laplace checks this by its own weights
# and rejects itself otherwise. The cost of the sum grows with the record; the cost of the compressed likelihood does
# not.

# %% [markdown]
# ## Simplifying the model
#
# `fitact.plan(scene)` starts from everything in the scene (here the body's resistance R_H, a different grounding
# finger, a probe, edges of 20 µs), omits one element after another, and selects the cheapest combination within the
# tolerance.

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
plan.plot()
plt.show()
assert plan.nominal.force <= 0.01
assert "grounding skin" not in plan.left_out
plan

# %% [markdown]
# For some fingers of the prior, the omissions exceed the tolerance, although they keep it at the nominal values. The
# plan warns about this. A narrower prior or a smaller tolerance keeps more elements.

# %%
print(plan.warnings[0])

# %% [markdown]
# ## What to take away
#
# - Response: use the exact one; the approximations are slower or less accurate, here both.
# - Likelihood: use the compressed one, the default; its error is checked on each record and negligible.
# - Posterior: emcee on the compressed likelihood is cheap. `laplace` suffices for a first look if it does not reject
#   itself.
# - Model: state every element in the scene, and let the plan omit what the tolerance does not need.
