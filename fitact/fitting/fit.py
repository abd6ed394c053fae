"""Fit records: parameters, their covariance, and whether the fit is reliable."""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from fitact.blas import limit_to_one_thread
from fitact.compiled import double_precision
from fitact.data.kramers_kronig import check_kramers_kronig
from fitact.data.record import Record
from fitact.data.spectrum import Spectrum
from fitact.errors import InputError
from fitact.fitting import derived, remarks
from fitact.fitting.calibrate import CalibratedInstruments, calibrate
from fitact.fitting.channel_fit import ChannelFit, information_criteria
from fitact.fitting.effects import assess_fit, is_assessed, is_tolerable
from fitact.fitting.error_sources import (
    gain_shifts,
    list_error_sources,
    noise_information,
)
from fitact.fitting.geometry import UncertainGeometry
from fitact.fitting.laplace import Laplace
from fitact.fitting.multistart import Optima, fit_from_starts
from fitact.fitting.residual_statistics import is_misfit, is_undersampled, pooled_statistics
from fitact.fitting.result import Fit
from fitact.fitting.verdict import diagnose_fit, misfit_warnings
from fitact.likelihood import certificate
from fitact.likelihood.likelihood import CircuitValues
from fitact.problem.build import Problem, build_problem
from fitact.problem.drive_choice import DriveModel
from fitact.problem.experiment import experiment_from_problem
from fitact.scene.scene import Scene


def fit(
    record: Record | Spectrum | Sequence[Record | Spectrum],
    scene: Scene | Sequence[Scene] | None = None,
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
) -> Fit:
    """Fit one circuit to records and spectra, jointly, by Levenberg-Marquardt in log-parameters with their prior.

    The scene of the first record (or spectrum, without records) gives the circuit, the prior and the device. The drive
    is the recorded V if there is no scene or its waveform is "measured", otherwise the waveform of the record's scene.
    Each channel has its own noise; that of a recorded V is part of the likelihood of I, whose delay is then free.
    Offset, drift, mains hum and (for Vsc) delay and clock error are added as free parameters if the BIC favours them;
    a gain is free with a prior in the scene, or where V is coarsely rounded. The start is estimated from the records.
    Computes in double precision and leaves the setting of JAX unchanged.

    Args:
        record: record or spectrum, or several. A record has the channels of the scene; V too, unless the scene states
            the drive. The force is that of the first record's drive, or of the scene's if there are only spectra.
        scene: device, circuit and prior; one for all records, or one for each.
        prior: whether to use the prior of the circuit; gains, delays and clocks always keep theirs.
        start: parameter values (SI) to start from instead of the estimate from the data.
        starts: number of starting points; the first is estimated from the data, the others are drawn from the prior
            and reveal further optima.
        tolerance: largest error of the log-likelihood from compression; 0 sums over all samples in each evaluation.
            `Fit.full_because` gives the reason where compression is not accurate enough.

    Raises:
        InputError: a record is impossible for this circuit, the scene needs a model that is not available, `start`
            names an unknown parameter, or the tolerance is negative or not a number.
    """
    records = (record,) if isinstance(record, Record | Spectrum) else tuple(record)
    scenes = (scene,) * len(records) if scene is None or isinstance(scene, Scene) else tuple(scene)
    return fit_records(records, scenes, prior=prior, start=start, starts=starts, tolerance=tolerance)


def fit_records(
    records: tuple[Record | Spectrum, ...],
    scenes: tuple[Scene | None, ...],
    drives: Sequence[DriveModel | None] = (),
    *,
    prior: bool = True,
    start: Mapping[str, float] | None = None,
    starts: int = 1,
    tolerance: float = certificate.TOLERANCE,
    excluded: Sequence[Bool[np.ndarray, " samples"]] = (),
) -> Fit:
    """Fit records as `fit` does.

    `drives` are the drives of the first records if they were chosen already; `excluded` are masks of samples (with
    padding), one for each channel, that do not enter the likelihood.
    """
    if not 0.0 <= tolerance < math.inf:
        raise InputError(f"tolerance = {tolerance}: give an error of the log-likelihood, 0.001 or so, or 0 for none")
    if starts < 1:
        raise InputError(f"starts = {starts}: give 1 or more")
    if not records or len(scenes) != len(records):
        raise InputError(f"{len(records)} records and {len(scenes)} scenes: give one scene for all, or one for each")
    if len({record.fingerprint for record in records}) < len(records):
        raise InputError(
            f"{records[0].source}: one record was given twice, which would count its samples twice; drop one"
        )
    for scene in scenes:
        (scene or Scene()).require_available(fit=True)
    pairs = sorted(zip(records, scenes, strict=True), key=lambda pair: isinstance(pair[0], Spectrum))  # records first
    records, scenes = (tuple(each) for each in zip(*pairs, strict=True))
    with double_precision(), limit_to_one_thread():
        try:
            problem = build_problem(records, scenes, prior, drives)
            for i, mask in enumerate(excluded):
                problem = problem.exclude_samples(i, mask)
            calibrated = calibrate(scenes[0], problem.likelihood.prior.names, fit_records)
            if calibrated.calibration is not None:
                likelihood = dataclasses.replace(problem.likelihood, calibration=calibrated.calibration)
                problem = problem._replace(likelihood=likelihood)
            optima = fit_from_starts(problem, tolerance, start, starts)
            found = _assemble_fit(problem, optima, calibrated, without_scene=scenes[0] is None)
            figures = {"optima": optima.distinct, "starts_failed": optima.failed} if starts > 1 else {}
            return dataclasses.replace(found, figures=found.figures | figures)
        except InputError:
            raise
        except Exception as error:  # whatever it is, other records are to go on
            raise InputError(
                f"{records[0].source}: the channels cannot be computed with ({type(error).__name__}: {error}); check"
                " for a huge offset, a wrong unit, or a channel without a signal"
            ) from error


def _assemble_fit(problem: Problem, optima: Optima, calibrated: CalibratedInstruments, without_scene: bool) -> Fit:
    solved, certified, root = optima.best
    likelihood, theta, sigma = certified.likelihood, solved.theta, solved.sigma
    first = problem.sources[0]
    optimum = likelihood.evaluate_circuit(theta)
    if isinstance(first.record, Spectrum):
        derive = derived.derived_from_scene(likelihood, first.scene)
    else:
        derive = derived.derived_from_fit(likelihood, first.record, first.choice, first.scene, float(optimum.b))
    charges = solved.unknown_charges()
    log_derived = derive.log_value_and_grad(theta, charges)
    geometry = UncertainGeometry.from_scene(first.scene, derive.geometry)
    laplace = Laplace(theta, root, sigma, likelihood, derive, charges, log_derived, geometry)
    traces = tuple(
        ChannelFit.from_optimum(solved.likelihood, i, theta, float(sigma[i]), optimum, source, certified.reasons[i])
        for i, source in enumerate(problem.sources)
    )
    figures = pooled_statistics([channel.figures for channel in traces]) | {"steps": solved.steps}
    figures |= information_criteria(theta.size, traces)
    channels = [trace.channel for trace in traces]
    stray = None
    if remarks.has_unstated_stray(problem.sources, channels):
        stray = remarks.estimate_stray_changes(channels, optimum)
    said = _collect_remarks(problem, laplace, traces, optimum, stray, without_scene)
    tests = [check_kramers_kronig(each.record) for each in traces if isinstance(each.record, Spectrum)]
    doubts = [test.doubt for test in tests if test.doubt]
    result, effects = diagnose_fit(solved, root, traces, optima.has_rival), None
    poor = [trace for trace in traces if is_misfit(trace.figures)]
    if result == "misfit" and any(trace.channel != "Ft" for trace in poor):
        effects = assess_fit(laplace, traces, has_structure=True)
        # what a poor fit of the friction, or of a current with a recorded drive, may move is not assessed
        assessed = {each.label for each in likelihood.channels if is_assessed(each)}
        may_move = any(is_undersampled(trace.figures) or trace.label not in assessed for trace in poor)
        if effects is not None and not may_move and is_tolerable(effects, laplace, first.scene.tolerance.force):
            result = "structure"
    return Fit(
        laplace,
        result=result,
        figures=figures,
        scene=first.scene,
        warnings=(*calibrated.warnings, *dict.fromkeys([*said.warnings, *doubts])),
        notes=(*calibrated.notes, *dict.fromkeys(said.notes)),
        traces=traces,
        compression_error=certified.error,
        experiment=experiment_from_problem(problem, likelihood, optimum, theta, sigma, charges.voltages),
        error_sources=list_error_sources(likelihood, problem.coordinates, first.scene),
        noise_information=noise_information(likelihood, solved),
        gain_shifts=gain_shifts(likelihood, solved, root),
        stray_changes=stray or {},
        misfit_effects=effects,
        kramers_kronig=max(tests, key=lambda test: (not test.passed, test.worst_residual), default=None),
    )


def _collect_remarks(
    problem: Problem,
    laplace: Laplace,
    traces: tuple[ChannelFit, ...],
    optimum: CircuitValues,
    stray_changes: Mapping[str, float] | None,
    without_scene: bool,
) -> remarks.Remarks:
    """Return what is to be said of the records, the parameters and the scene."""
    likelihood, theta, first = laplace.likelihood, laplace.theta, problem.sources[0]
    warnings: list[str] = []
    notes = [source.scene.description for source in problem.sources if source.scene.description]
    for source in problem.sources:
        fitted = {channel.channel for channel in traces if channel.record is source.record}
        if isinstance(source.record, Record):
            notes += remarks.unfitted_channel_notes(source.record, fitted)
    for source, channel in zip(problem.sources, traces, strict=True):
        warnings += source.warnings
        notes += source.notes
        if isinstance(source.record, Record):
            warnings += remarks.channel_warnings(source.record, source.choice, channel.channel, channel.figures)
    warnings += misfit_warnings(traces)
    warnings += remarks.parameter_warnings(likelihood, theta)
    warnings += remarks.skewness_warnings(laplace)
    stated = [each.name for each in problem.coordinates if each.is_stated]
    spread = np.linalg.norm(laplace.covariance_root, axis=1)
    warnings += remarks.prior_warnings(likelihood, theta, spread, stated)
    force_peak = math.exp(laplace.log_derived[0][derived.DERIVED_NAMES.index("force_peak")])
    warnings += remarks.plausibility_warnings(first.record, first.scene, first.choice, optimum, force_peak)
    if stray_changes is not None:
        notes.append(remarks.stray_note(stray_changes))
    assumed = remarks.describe_assumed_Ci(None if without_scene else first.scene, likelihood, laplace.prior_sets_Ci)
    notes += assumed.notes
    notes += laplace.geometry.notes(first.scene, likelihood, theta)
    return remarks.Remarks(tuple(notes), (*warnings, *assumed.warnings))
