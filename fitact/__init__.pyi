from .data.formats import read
from .data.record import Record
from .errors import InputError
from .inference.fit import Fit, fit
from .inference.least_squares import RESULTS
from .inference.posterior import Posterior
from .inference.sampling import sample
from .model.circuit import DirectGround, FinalCircuit, NaturalGround, Probe
from .model.drive import Sampled, Sine, Square, Trapezoid, Triangle
from .model.force import Contact, electrostatic_force, friction, mean_force, peak_force
from .model.prior import LogNormal, Prior, Uniform
from .model.response import response
from .model.scene import Scene
from .model.steady import body_current, mean_square, peak

__all__ = [
    "RESULTS",
    "Contact",
    "DirectGround",
    "FinalCircuit",
    "Fit",
    "InputError",
    "LogNormal",
    "NaturalGround",
    "Posterior",
    "Prior",
    "Probe",
    "Record",
    "Sampled",
    "Scene",
    "Sine",
    "Square",
    "Trapezoid",
    "Triangle",
    "Uniform",
    "body_current",
    "electrostatic_force",
    "fit",
    "friction",
    "mean_force",
    "mean_square",
    "peak",
    "peak_force",
    "read",
    "response",
    "sample",
]

__version__: str
