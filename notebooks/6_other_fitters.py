# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Can other circuit fitters do this?
#
# SciPy and lmfit fit curves; impedance.py, pyimpspec, ImpedanceFitter and AutoEIS fit circuits to impedance spectra,
# and do so for many laboratories. They read no drive, and know neither force nor skin; but the circuit's impedance is
# something that all of them can be asked for. Here each gets the same spectra and the same starts, first in the way
# that its documentation begins with, then with the help that it offers, and in units that make all numbers near 1.
#
# `make peers` builds the environment that they run in.

# %%
import json
import subprocess
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fitact

plt.style.use("style.mplstyle")
PYTHON = Path("../out/peers/bin/python")
assert PYTHON.exists(), "the other fitters are not there; run: make peers"

# %% [markdown]
# ## The task
#
# Two equal layers of skin and the insulator: 2 Rsc ‖ Csc / 2 in series with Ci, from 1 Hz to 100 kHz, with 0.3 % of
# noise on size and phase. The starts are within a factor of five of the truth in each parameter. The best that an
# unbiased fit can do follows from the Jacobian (Cramér and Rao); right is here what lies within four of those
# standard deviations in all three parameters.

# %%
TRUTH = np.array([2 * 130e3, 18e-9 / 2, 1.4e-9])  # ohm, F, F
NOISE, CASES = 3e-3, 20
frequency = np.geomspace(1.0, 1e5, 41)


def impedance(values: np.ndarray) -> np.ndarray:
    s = 2j * np.pi * frequency
    return values[0] / (1 + s * values[0] * values[1]) + 1 / (s * values[2])


random = np.random.default_rng(1)
cases = []
for _ in range(CASES):
    z = impedance(TRUTH) * np.exp(NOISE * (random.standard_normal(41) + 1j * random.standard_normal(41)))
    start = TRUTH * 5.0 ** random.uniform(-1, 1, 3)
    cases.append({"real": z.real.tolist(), "imag": z.imag.tolist(), "start": start.tolist()})

step = 1e-5
columns = [np.log(impedance(TRUTH * np.exp(step * e)) / impedance(TRUTH * np.exp(-step * e))) for e in np.eye(3)]
jacobian = np.stack([np.concatenate([c.real, c.imag]) for c in columns], axis=1) / (2 * step)
best = NOISE * TRUTH * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
print(
    "best possible:",
    ", ".join(f"{name} ± {100 * x:.2g} %" for name, x in zip(("R", "C", "Ci"), best / TRUTH, strict=True)),
)

# %% [markdown]
# ## Their answers
#
# AutoEIS compiles anew for each spectrum and gets the first five; what it is known for, the search for a circuit, is
# not asked of it.

# %%
done = subprocess.run(
    [PYTHON, "peers/fit_spectra.py"],
    input=json.dumps({"frequency": frequency.tolist(), "cases": cases}),
    capture_output=True,
    text=True,
    check=False,
)
assert done.returncode == 0, done.stderr
answer = json.loads(done.stdout)
print(", ".join(f"{name} {version}" for name, version in answer["versions"].items()))

# %% [markdown]
# And fitact, which takes no start: it finds its own from the spectrum. Its prior is wide and off the truth.

# %%
prior = {name: {"median": m, "factor": 30} for name, m in (("Rsc", "80 kohm"), ("Csc", "40 nF"), ("Ci", "1 nF"))}
scene = fitact.Scene.from_dict({"prior": prior})
rows = []
for case in cases:
    z = np.array(case["real"]) + 1j * np.array(case["imag"])
    found = fitact.fit_spectrum(fitact.Spectrum.from_arrays(frequency, z), scene)
    parts = [found.parameters()[name] for name in ("Rsc", "Csc", "Ci")]
    values, errors = (np.array([part[key] for part in parts]) * [2.0, 0.5, 1.0] for key in ("q50", "sd"))
    rows.append({"values": values.tolist(), "errors": errors.tolist(), "said": found.result})
attempts = [*answer["found"], {"peer": "fitact", "how": "no start needed", "rows": rows}]

# %% [markdown]
# ## Right, and wrong in which way
#
# A wrong answer does little harm where its own errors admit it. It does where they exclude the truth, by four of its
# own standard deviations or more.

# %%
VERDICTS = {
    "right": "C2",
    "wrong, and its errors are as wide": "C4",
    "wrong, without errors, or an exception": "0.6",
    "wrong, and its errors exclude the truth": "C1",
}


def verdict(row: dict) -> str:
    right, wide, bare, silent = VERDICTS
    if row["values"] is None:
        return bare
    off = np.abs(np.array(row["values"]) - TRUTH)
    if np.all(off < 4 * best):
        return right
    if row["errors"] is None:
        return bare
    return wide if np.all(off < 4 * np.array(row["errors"])) else silent


table = {(a["peer"], a["how"]): [verdict(row) for row in a["rows"]] for a in attempts}
figure, here = plt.subplots(figsize=(10, 7.5))
for y, verdicts in enumerate(table.values()):
    left = 0.0
    for name, color in VERDICTS.items():
        share = verdicts.count(name) / len(verdicts)
        here.barh(y, share, left=left, color=color, label=name if y == 0 else None)
        left += share
    here.text(1.01, y, f"{verdicts.count('right')} of {len(verdicts)}", va="center")
here.set_yticks(range(len(table)), [f"{peer}: {how}" for peer, how in table])
here.invert_yaxis()
here.grid(False)
here.set(xlabel="share of the spectra", xlim=(0, 1.1), title="The same spectra, the same starts")
here.legend(loc="upper center", bbox_to_anchor=(0.3, -0.08), ncols=2)
plt.show()

# %% [markdown]
# What the most confident of the wrong ones claimed:

# %%
for a in attempts:
    silent = [row for row in a["rows"] if verdict(row) == list(VERDICTS)[-1]]
    if silent:
        row = min(silent, key=lambda row: row["errors"][0] / row["values"][0])
        claim = f"R = {row['values'][0]:.4g} ± {row['errors'][0]:.1g} ohm"
        print(f"{a['peer'] + ': ' + a['how']:50} {claim}  {row['said']}")
least = min(row["errors"][0] for a in attempts if a["peer"] == "impedance.py" for row in a["rows"])
assert least < 1e-20
print(f"{'the truth':50} R = {TRUTH[0]:.4g} ohm, to be known to ± {best[0]:.1g} ohm")

# %% [markdown]
# The cause is one: resistances of 1e5 and capacitances of 1e-9 in one vector. A step that is small for the one is
# nothing or everything for the other, so SciPy's `least_squares`, which most of these call, ends beside its start and
# reports that a tolerance is met. Logarithms, units that make all numbers near 1, or MINPACK's `leastsq`, which
# scales by itself, cure it. (Not in pyimpspec, whose residuals are squares already: there it takes the units.)

# %%
right = {key: verdicts.count("right") / len(verdicts) for key, verdicts in table.items()}
for key in (
    ("scipy", "parameters in ohm and farad"),
    ("impedance.py", "default"),
    ("impedance.py", "weighted"),
    ("ImpedanceFitter", "default"),
    ("AutoEIS", "fit_circuit_parameters"),
):
    assert right[key] == 0.0
for key in (
    ("scipy", "logarithms"),
    ("lmfit", "leastsq (default), bounds"),
    ("impedance.py", "weighted, scaled units"),
    ("ImpedanceFitter", "weighted, scaled units"),
    ("AutoEIS", "the same, scaled units"),
    ("AutoEIS", "Bayesian inference"),
    ("fitact", "no start needed"),
):
    assert right[key] == 1.0

# %% [markdown]
# ## What to take away
#
# - In ohm and farad, as their first examples are written, most of the fitters do not leave their starts on this
#   circuit; impedance.py then claims to know R to 3e-22 ohm.
# - None of them is unfit for it: with scaled units or logarithms, and weights, each is right, or nearly always.
#   lmfit's default and AutoEIS's Bayesian inference are right as they come.
# - So the difference is not in the optimiser. fitact fits in logarithms, starts from the data, and says where an
#   answer must not be trusted. What the others do not do at all is records in time, drives, and force.
