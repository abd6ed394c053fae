from .batch.campaign import run_campaign
from .batch.fit_many import Fits, fit_many
from .batch.sample_many import sample_many
from .data.record import Record
from .data.spectrum import Spectrum
from .design.drive import design_drive
from .design.drive_design import DriveDesign
from .design.measurement import MeasurementDesign, design_measurement
from .errors import InputError
from .fitting.fit import fit
from .fitting.outcome import RESULTS
from .fitting.result import Fit
from .inspection.inspection import Inspection, inspect
from .model.chirp import Chirp
from .model.circuit import DirectGround, FinalCircuit, NaturalGround, Probe
from .model.drive import Burst, Multitone, Polyline, Sampled, Sine, Square, Trapezoid, Triangle
from .model.force import Contact, electrostatic_force, friction, mean_force, peak_force
from .model.harmonic import harmonic_error, harmonic_response
from .model.response import response
from .model.skin import Dispersive, Fractional, WithSkin, quality_factor, series_equivalent
from .model.steady import body_current, mean_square, peak
from .model_selection.comparison import Comparison, compare
from .model_selection.plan import Plan, plan
from .populations.fit_population import population
from .populations.population import Population
from .prior.distributions import LogNormal, LogUniform, TruncatedLogNormal, Uniform
from .prior.prior import Prior
from .readers.read import read
from .readers.spectrum import read_spectra, read_spectrum
from .readers.study import Study
from .sampling.ensemble import sample
from .sampling.posterior import Posterior
from .scene.scene import Scene
from .tracking.track import Track
from .tracking.track_record import track
from .tradeoff.tradeoff import Tradeoff, measure_tradeoff

__all__ = [
    "RESULTS",
    "Burst",
    "Chirp",
    "Comparison",
    "Contact",
    "DirectGround",
    "Dispersive",
    "DriveDesign",
    "FinalCircuit",
    "Fit",
    "Fits",
    "Fractional",
    "InputError",
    "Inspection",
    "LogNormal",
    "LogUniform",
    "MeasurementDesign",
    "Multitone",
    "NaturalGround",
    "Plan",
    "Polyline",
    "Population",
    "Posterior",
    "Prior",
    "Probe",
    "Record",
    "Sampled",
    "Scene",
    "Sine",
    "Spectrum",
    "Square",
    "Study",
    "Track",
    "Tradeoff",
    "Trapezoid",
    "Triangle",
    "TruncatedLogNormal",
    "Uniform",
    "WithSkin",
    "body_current",
    "compare",
    "design_drive",
    "design_measurement",
    "electrostatic_force",
    "fit",
    "fit_many",
    "friction",
    "harmonic_error",
    "harmonic_response",
    "inspect",
    "mean_force",
    "mean_square",
    "measure_tradeoff",
    "peak",
    "peak_force",
    "plan",
    "population",
    "quality_factor",
    "read",
    "read_spectra",
    "read_spectrum",
    "response",
    "run_campaign",
    "sample",
    "sample_many",
    "series_equivalent",
    "track",
]

__version__: str
