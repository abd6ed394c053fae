"""Typical script that fits a record with lmfit, priors as residuals; `first_answer.py` times it against `fitact fit`.

python benchmarks/lmfit_fit_script.py RECORD.csv
"""

import sys

import lmfit
import numpy as np
from scipy.signal import lfilter

NAMES = ("log_Rsc", "log_Csc", "log_Ci")
MEANS, SDS = np.log([130e3, 22e-9, 1.35e-9]), np.array([0.56, 0.4, 0.05])

time, drive, observed = np.loadtxt(sys.argv[1], delimiter=",", skiprows=1, usecols=(0, 1, 2)).T
step = time[1] - time[0]
slope = np.diff(drive, prepend=drive[0]) / step


def residual(params):
    logs = np.array([params[name].value for name in NAMES])
    R, C, Ci = np.exp(logs)
    b = R * (2.0 * Ci + C)
    decay = np.exp(-step / b)
    # first-order hold of R Ci s / (1 + b s), from the first sample of Vsc
    rise = (1.0 - decay) * R * Ci * slope
    rise[0] = observed[0]
    return np.append((lfilter([1.0], [1.0, -decay], rise) - observed) / 0.1, (logs - MEANS) / SDS)


params = lmfit.Parameters()
for name, value in zip(NAMES, MEANS, strict=True):
    params.add(name, value=value)
lmfit.report_fit(lmfit.minimize(residual, params))
