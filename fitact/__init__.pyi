from .campaign import run_campaign
from .data.formats import read
from .data.inspection import Inspection, inspect
from .data.record import Record
from .data.spectrum import Spectrum, read_spectrum
from .errors import InputError
from .inference.comparison import Comparison, compare
from .inference.design import MeasurementDesign, design_measurement
from .inference.drive_design import DriveDesign, design_drive
from .inference.fit import Fit, fit
from .inference.many import Fits, fit_many
from .inference.many_posteriors import sample_many
from .inference.people import Population
from .inference.population import population
from .inference.posterior import Posterior
from .inference.sampling import sample
from .inference.solver import RESULTS
from .inference.spectrum_fit import SpectrumFit, fit_spectrum
from .model.chirp import Chirp
from .model.circuit import DirectGround, FinalCircuit, NaturalGround, Probe
from .model.distribution import LogNormal, LogUniform, TruncatedLogNormal, Uniform
from .model.drive import Burst, Polyline, Sampled, Sine, Square, Trapezoid, Triangle
from .model.equivalents import quality_factor, series_equivalent
from .model.force import Contact, electrostatic_force, friction, mean_force, peak_force
from .model.harmonic import harmonic_error, harmonic_response
from .model.multitone import Multitone
from .model.plan import Plan, plan
from .model.prior import Prior
from .model.response import response
from .model.scene import Scene
from .model.skin import Dispersive, Fractional, WithSkin
from .model.steady import body_current, mean_square, peak
from .tradeoff import Tradeoff, measure_tradeoff

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
    "SpectrumFit",
    "Square",
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
    "fit_spectrum",
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
    "read_spectrum",
    "response",
    "run_campaign",
    "sample",
    "sample_many",
    "series_equivalent",
]

__version__: str
