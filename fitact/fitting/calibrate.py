"""Calibration of instruments by records of dummy circuits, whose parts are known."""

import functools
import math
import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fitact.errors import InputError
from fitact.experiment.blind_directions import STRAY
from fitact.fitting.result import Fit
from fitact.likelihood.calibration import Calibration
from fitact.model.circuit import FINGER_PARAMETERS
from fitact.readers.read import read
from fitact.scene.instrument_section import CalibrationSection, DummyCircuit
from fitact.scene.prior_section import PriorSection
from fitact.scene.scene import Scene
from fitact.units import format_engineering, format_percent, quantity_unit

FitRecords = Callable[..., Fit]  # `fitact.fitting.fit.fit_records`


# so small an insulator passes no current
_NO_FINGER = DummyCircuit.model_validate(
    {"Rsc": {"fixed": 1e6}, "Csc": {"fixed": 1e-9}, "Ci": {"nominal": 1e-18, "tolerance": 0.01}}
)


class CalibratedInstruments(NamedTuple):
    """Information from the calibration records of a scene, and sentences on them."""

    calibration: Calibration | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def calibrate(scene: Scene | None, names: tuple[str, ...], fit_records: FitRecords) -> CalibratedInstruments:
    """Fit the calibration records of a scene by `fit_records`; return what they tell about the coordinates `names`.

    Raises:
        InputError: a record cannot be read or fitted, or the scene states no instrument to calibrate.
    """
    if scene is None or not scene.calibration:
        return CalibratedInstruments()
    if STRAY not in names and any(each.circuit == "open" for each in scene.calibration):
        raise InputError(
            "scene: [[calibration]] circuit = 'open', a record without the finger, determines the stray capacitance;"
            ' state what is known of it before, [measurement] stray_capacitance = {median = "100 pF", relative_sd ='
            " 1.0}, with I in the drive lead"
        )
    if not scene.instrument.is_stated and any(each.circuit != "open" for each in scene.calibration):
        raise InputError("scene: [[calibration]] calibrates the pieces of [instrument]; state these too")
    contents = tuple(read(each.record, _dummy_scene(scene, each)).fingerprint for each in scene.calibration)
    return _calibrate(scene.to_json(), names, fit_records, contents)


@functools.lru_cache(maxsize=4)  # many records of one scene share them
def _calibrate(
    scene: str, names: tuple[str, ...], fit_records: FitRecords, _contents: tuple[str, ...]
) -> CalibratedInstruments:
    stated = Scene.from_json(scene)
    parts, notes, warnings = [], [], []
    for each in stated.calibration:
        dummy = _dummy_scene(stated, each)
        fitted = fit_records((read(each.record, dummy),), (dummy,))
        parts.append(_marginal_calibration(fitted, names))
        warnings += [f"calibration {os.path.basename(each.record)}: {text}" for text in _dummy_warnings(fitted)]
        known = ", ".join(
            f"{name} {format_percent(float(fitted.sd[fitted.names.index(name)]))}" for name in parts[-1].names
        )
        notes.append(f"calibration {os.path.basename(each.record)}: uncertainties are now {known}")
    return CalibratedInstruments(_join_calibrations(parts), tuple(notes), tuple(warnings))


def _dummy_scene(scene: Scene, stated: CalibrationSection) -> Scene:
    """Return the scene of a calibration record: that of the finger with the parts of the dummy, or with none."""
    measurement, parts = scene.measurement, stated.circuit
    if parts == "open":
        measurement, parts = measurement.model_copy(update={"channels": ("I",)}), _NO_FINGER
    own = {name: getattr(parts, name) for name in FINGER_PARAMETERS}
    prior = PriorSection(stray_capacitance=scene.prior.stray_capacitance, **own)
    return Scene(drive=scene.drive, measurement=measurement, instrument=scene.instrument, prior=prior)


def _dummy_warnings(fitted: Fit, max_pull: float = 3.0) -> list[str]:
    """Return warnings about a record that does not fit its dummy circuit, or parts that are not as stated."""
    warnings = [] if fitted.trusted else [fitted.message]
    for name in FINGER_PARAMETERS:
        if name in fitted.names:
            marginal, theta = fitted.likelihood.prior[name], fitted.theta[fitted.names.index(name)]
            pull = (theta - marginal.log_mean) / marginal.log_sd
            if abs(pull) > max_pull:
                found = format_engineering(math.exp(theta), quantity_unit(name))
                warnings.append(
                    f"the record puts {name} of the dummy at {found},"
                    f" {abs(pull):.1f} standard uncertainties from the stated value; check the parts, and the scale of"
                    " the channels"
                )
    return warnings


def _marginal_calibration(fitted: Fit, names: tuple[str, ...]) -> Calibration:
    """Return what a fit tells about those of the coordinates `names` that it has, whatever its other parameters are."""
    names = tuple(name for name in fitted.likelihood.prior.names if name in names and name not in FINGER_PARAMETERS)
    shared = [fitted.names.index(name) for name in names]
    own = [i for i in range(len(fitted.names)) if i not in shared]
    precision = np.linalg.inv(fitted.likelihood.prior_factor @ fitted.likelihood.prior_factor.T)
    own_prior = np.linalg.cholesky(precision[np.ix_(own, own)]).T
    data = np.concatenate(list(fitted.noise_information.values()))
    rows = np.vstack([data[:, [*own, *shared]], np.hstack([own_prior, np.zeros((len(own), len(shared)))])])
    root = np.asarray(np.linalg.qr(rows, mode="r"))[len(own) :, len(own) :]
    center = fitted.theta[shared]
    # at the optimum, the gradient of the data balances that of the shared coordinates' prior
    mean = np.array([fitted.likelihood.prior[name].log_mean for name in names])
    gradient = -precision[np.ix_(shared, shared)] @ (center - mean)
    return Calibration(root, center, np.linalg.lstsq(root.T, gradient, rcond=1e-10)[0], names)


def _join_calibrations(parts: Sequence[Calibration]) -> Calibration:
    """Return several calibrations of the same coordinates as one."""
    first = parts[0]
    offsets = [each.root @ (first.center - each.center) + each.offset for each in parts]
    roots = np.concatenate([each.root for each in parts])
    return Calibration(roots, first.center, np.concatenate(offsets), first.names)
