"""Typical script to fit and sample a record with lmfit; `posterior.py` times it against `fitact run`.

python benchmarks/lmfit_script.py RECORD.csv STEPS FIGURE.png
"""

import sys

import corner
import lmfit
import numpy as np

V0, FREQUENCY, WALKERS = 180.0, 100.0, 32
NAMES = ("log_Rsc", "log_Csc", "log_Ci", "log_sigma")
MEANS = np.log([160e3, 22e-9, 1.35e-9])
SDS = np.sqrt(np.log1p(np.square([0.3, 0.3, 0.05])))

path, steps, figure = sys.argv[1], int(sys.argv[2]), sys.argv[3]
with open(path, encoding="utf-8") as file:
    header = file.readline().strip().split(",")
table = np.loadtxt(path, delimiter=",", skiprows=1)
drive, observed = table[:, header.index("V_V")], table[:, header.index("Vsc_V")]
per_period = round(1.0 / FREQUENCY / (table[1, 0] - table[0, 0]))
sign = np.sign(drive[:per_period])
since = (np.arange(per_period) % (per_period // 2)) * (table[1, 0] - table[0, 0])
observed = observed.reshape(-1, per_period)


def residual(params):
    R, C, Ci, sigma = np.exp([params[name].value for name in NAMES])
    g, b = Ci / (2.0 * Ci + C), R * (2.0 * Ci + C)
    model = sign * 2.0 * V0 * g / (1.0 + np.exp(-0.5 / FREQUENCY / b)) * np.exp(-since / b)
    return ((observed - model) / sigma).ravel()


def prior(params):
    return (np.array([params[name].value for name in NAMES[:3]]) - MEANS) / SDS


def log_posterior(params):
    left, prior_residual = residual(params), prior(params)
    return -0.5 * (left @ left + prior_residual @ prior_residual) - left.size * params["log_sigma"].value


params = lmfit.Parameters()
for name, value in zip(NAMES, (*MEANS, np.log(0.1)), strict=True):
    params.add(name, value=value, vary=name != "log_sigma")
fit = lmfit.minimize(lambda p: np.append(residual(p), prior(p)), params, scale_covar=False)
best = fit.params
best["log_sigma"].set(vary=True)
rng = np.random.default_rng(0)
root = np.zeros((4, 4))
root[:3, :3] = np.linalg.cholesky(fit.covar)
root[3, 3] = np.sqrt(0.5 / observed.size)
starts = np.array([best[name].value for name in NAMES]) + rng.standard_normal((WALKERS, 4)) @ root.T
sampled = lmfit.Minimizer(log_posterior, best).emcee(
    steps=steps, burn=steps // 20, nwalkers=WALKERS, pos=starts, float_behavior="posterior", progress=False
)
corner.corner(sampled.flatchain.to_numpy(), labels=NAMES).savefig(figure)
lmfit.report_fit(sampled)
