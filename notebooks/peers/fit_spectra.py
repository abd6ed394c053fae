"""Other fitters on the spectra of `6_other_fitters.py`, with JSON on standard input and output.

The circuit is R parallel to C1, in series with C2. A case is a spectrum and a starting point (ohm, F, F).
"""

import contextlib
import io
import json
import logging
import sys
import time
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import autoeis
import impedancefitter
import lmfit
import numpy as np
import pandas as pd
import pyimpspec
import scipy.optimize
from impedance.models.circuits import CustomCircuit

UNITS = np.array([1e6, 1e-9, 1e-9])  # Mohm and nF: with kHz all numbers are close to 1
KILO = 1e3


class Found(NamedTuple):
    """Values, their stated errors, and the fitter's message."""

    values: Any
    errors: Any
    said: str


Fitter = Callable[[np.ndarray, np.ndarray, np.ndarray], Found]  # arguments: frequency, impedance and start


def scaled(fitter: Fitter) -> Fitter:
    """Return the same fitter in Mohm, nF and kHz."""

    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        values, errors, said = fitter(f / KILO, z / UNITS[0], start / UNITS)
        return Found(values * UNITS, None if errors is None else errors * UNITS, said)

    return fit


def residuals(p: Any, f: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return residuals relative to the magnitude of the impedance."""
    s = 2j * np.pi * f
    off = (p[0] / (1.0 + s * p[0] * p[1]) + 1.0 / (s * p[2]) - z) / np.abs(z)
    return np.concatenate([off.real, off.imag])


def of_scipy(log: bool = False, **settings: Any) -> Fitter:
    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        def left(x: np.ndarray) -> np.ndarray:
            return residuals(np.exp(x) if log else x, f, z)

        found = scipy.optimize.least_squares(left, np.log(start) if log else start, **settings)
        with contextlib.suppress(np.linalg.LinAlgError):
            variance = 2.0 * found.cost / (2 * f.size - 3) * np.diag(np.linalg.inv(found.jac.T @ found.jac))
            values = np.exp(found.x) if log else found.x
            return Found(values, np.sqrt(np.abs(variance)) * (values if log else 1.0), found.message)
        return Found(found.x, None, found.message)

    return fit


def of_lmfit(method: str, log: bool = False) -> Fitter:
    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        params = lmfit.Parameters()
        for name, value in zip(("R", "C1", "C2"), start, strict=True):
            if log:
                params.add(f"log_{name}", value=np.log(value))
                params.add(name, expr=f"exp(log_{name})")
            else:
                params.add(name, value=value, min=value / 100.0, max=value * 100.0)
        found = lmfit.minimize(lambda p: residuals([p[k].value for k in ("R", "C1", "C2")], f, z), params, method)
        return from_params([found.params[name] for name in ("R", "C1", "C2")], found.message)

    return fit


def from_params(params: list[Any], said: str) -> Found:
    """Return the result of lmfit's parameters."""
    errors = [p.stderr for p in params]
    return Found(np.array([p.value for p in params]), None if None in errors else np.array(errors), said)


def of_impedance(**settings: Any) -> Fitter:
    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        circuit = CustomCircuit("p(R1,C1)-C2", initial_guess=list(start))
        circuit.fit(f, z, **settings)
        return Found(circuit.parameters_, circuit.conf_, "")

    return fit


def of_pyimpspec(**settings: Any) -> Fitter:
    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        circuit = pyimpspec.parse_cdc("(RC)C")
        for element, name, value in zip(circuit.get_elements(), "RCC", start, strict=True):
            element.set_values(**{name: value})
        found = pyimpspec.fit_circuit(circuit, pyimpspec.DataSet(f, z), num_procs=1, **settings)
        parts = [found.parameters[name][name[0]] for name in ("R_1", "C_1", "C_2")]
        errors = np.array([part.stderr for part in parts])
        said = f"{found.minimizer_result.message} ({found.method}, {found.weight})"
        return Found(np.array([part.value for part in parts]), None if np.isnan(errors).any() else errors, said)

    return fit


def of_impedancefitter(**settings: Any) -> Fitter:
    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        columns = {"df_freq_column": "f", "df_real_column": "re", "df_imag_column": "im"}
        table = pd.DataFrame({"f": f, "re": z.real, "im": z.imag})
        names = ("s_R", "s_C", "i_C")
        bounded = {name: {"value": value, "min": 0.0} for name, value in zip(names, start, strict=True)}
        fitter = impedancefitter.Fitter("DF", df=table, LogLevel="WARNING", **columns)
        fitter.run("parallel(R_s, C_s) + C_i", parameters=bounded, **settings)
        found = fitter.fittedValues
        return from_params([found.params[name] for name in names], found.message)

    return fit


def of_autoeis(bayesian: bool) -> Fitter:
    names = ("R1", "C2", "C3")

    def fit(f: np.ndarray, z: np.ndarray, start: np.ndarray) -> Found:
        guess = dict(zip(names, map(float, start), strict=True))
        if not bayesian:
            found = autoeis.utils.fit_circuit_parameters("[R1,C2]-C3", f, z, p0=guess)
            return Found(np.array([found[name] for name in names]), None, "")
        settings = {"p0": guess, "seed": 0, "progress_bar": False, "parallel": False}
        (found,) = autoeis.perform_bayesian_inference("[R1,C2]-C3", f, z, **settings)
        draws = np.array([found.samples[name] for name in names])
        return Found(np.median(draws, axis=1), np.std(draws, axis=1), f"converged: {found.converged}")

    return fit


MODULUS = {"weighting": "modulus"}
FITTERS: dict[tuple[str, str], Fitter] = {
    ("scipy", "parameters in ohm and farad"): of_scipy(bounds=(0.0, np.inf)),
    ("scipy", "scaled by the Jacobian"): of_scipy(x_scale="jac", bounds=(0.0, np.inf)),
    ("scipy", "logarithms"): of_scipy(log=True),
    ("lmfit", "least_squares, bounds"): of_lmfit("least_squares"),
    ("lmfit", "leastsq (default), bounds"): of_lmfit("leastsq"),
    ("lmfit", "logarithms"): of_lmfit("leastsq", log=True),
    ("impedance.py", "default"): of_impedance(),
    ("impedance.py", "weighted"): of_impedance(weight_by_modulus=True),
    ("impedance.py", "weighted, scaled units"): scaled(of_impedance(weight_by_modulus=True)),
    ("pyimpspec", "default (all methods and weights)"): of_pyimpspec(),
    ("pyimpspec", "leastsq, Boukamp's weights"): of_pyimpspec(method="leastsq", weight="boukamp"),
    ("pyimpspec", "the same, scaled units"): scaled(of_pyimpspec(method="leastsq", weight="boukamp")),
    ("ImpedanceFitter", "default"): of_impedancefitter(),
    ("ImpedanceFitter", "weighted"): of_impedancefitter(**MODULUS),
    ("ImpedanceFitter", "weighted, leastsq"): of_impedancefitter(solver="leastsq", **MODULUS),
    ("ImpedanceFitter", "weighted, scaled units"): scaled(of_impedancefitter(**MODULUS)),
    ("AutoEIS", "fit_circuit_parameters"): of_autoeis(False),
    ("AutoEIS", "the same, scaled units"): scaled(of_autoeis(False)),
    ("AutoEIS", "Bayesian inference"): of_autoeis(True),
}
FEWER = {key: 5 for key in FITTERS if key[0] == "AutoEIS"}  # compiles for each case


def attempts(fitter: Fitter, f: np.ndarray, cases: list[dict[str, Any]]) -> dict[str, Any]:
    """Return values, stated errors and message of each case, or the last line of its exception."""
    rows, began = [], time.perf_counter()
    for case in cases:
        try:
            found = fitter(f, np.array(case["real"]) + 1j * np.array(case["imag"]), np.array(case["start"]))
            errors = None if found.errors is None else np.asarray(found.errors, dtype=float).tolist()
            rows.append(
                {"values": np.asarray(found.values, dtype=float).tolist(), "errors": errors, "said": found.said}
            )
        except Exception as error:  # an exception is recorded as the fitter's result
            rows.append({"values": None, "errors": None, "said": str(error).strip().splitlines()[-1]})
    return {"rows": rows, "seconds": time.perf_counter() - began}


def main() -> None:
    given = json.load(sys.stdin)
    f, cases = np.array(given["frequency"]), given["cases"]
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):
        found = [
            {"peer": peer, "how": how} | attempts(fitter, f, cases[: FEWER.get((peer, how))])
            for (peer, how), fitter in FITTERS.items()
        ]
    packages = ("scipy", "lmfit", "impedance", "pyimpspec", "impedancefitter", "autoeis")
    json.dump({"found": found, "versions": {name: version(name) for name in packages}}, sys.stdout)


if __name__ == "__main__":
    main()
