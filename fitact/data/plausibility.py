"""Plausibility of what a force is computed from: one warning with the likely cause, most often a wrong unit."""

import numpy as np

from fitact.data.record import LARGEST_VALUES
from fitact.model.circuit import RC, HighpassTerms
from fitact.scene.scene import Scene
from fitact.units import format_engineering

STRONGEST_FIELD = 1e9  # V/m; parylene of 5 um withstands this: Diaham et al., J. Appl. Phys. 115 (2014) 054102


def insulator_voltage(drive_peak: float, current: HighpassTerms, circuit: RC, frequency: float) -> float:
    """Return the peak voltage (V) across the insulator for a drive of this peak (V) and frequency (Hz).

    It follows from the `current` terms of the circuit. The drive counts as a sine.
    """
    s, tau, weight = 2j * np.pi * frequency, np.asarray(current.tau), np.asarray(current.weight)
    admittance = (current.direct or 0.0) + s * (current.rate or 0.0) + np.sum(weight * s * tau / (1.0 + s * tau))
    leak = 0.0 if circuit.Ri is None else 1.0 / np.asarray(circuit.Ri)
    return drive_peak * float(abs(admittance) / abs(leak + s * np.asarray(circuit.Ci)))


def check_plausibility(
    scene: Scene,
    drive_peak: float,
    insulator_peak: float,
    force_peak: float,
    max_area: float = 5e-4,  # m^2; five times the contact of the reference paper
    max_field: float = STRONGEST_FIELD,
) -> list[str]:
    """Return a warning with the likeliest cause if the scene, or a peak value (V, V, N), is implausible.

    A NaN is not checked.
    """
    device, load = scene.device, scene.friction.normal_force
    thickness, area = format_engineering(device.insulator_thickness, "m"), f"{1e4 * device.contact_area:.5g} cm^2"
    field, limit = insulator_peak / device.insulator_thickness, device.breakdown_field or max_field
    if drive_peak > LARGEST_VALUES["V"]:
        problem = f"the drive reaches {format_engineering(drive_peak, 'V')}, more than a touch display withstands"
        cause = "check the unit of V or of [drive] peak_to_peak, and the scale of the probe"
    elif device.contact_area > max_area:
        problem = f"[device] contact_area = {area} is larger than the contact of a fingertip, about 1 cm^2"
        cause = "check its unit: a plain number is in m^2"
    elif field > limit:
        known = "the strongest thin films" if device.breakdown_field is None else "[device] breakdown_field"
        problem = (
            f"the field in the insulator reaches {1e-6 * field:.4g} V/µm, above the {1e-6 * limit:.4g} V/µm of {known}"
        )
        cause = f"check the unit of [device] insulator_thickness, here {thickness}, then the drive"
    elif force_peak > load > 0.0:
        key = "[gap] thickness" if scene.force.model == "gap" else "[skin] thickness and of Ci"
        shown = (format_engineering(force, "N") for force in (force_peak, load))
        problem = "the electrostatic force reaches {}, more than the finger's normal force of {}".format(*shown)
        cause = f"check the unit of {key}, then the scale of V"
    else:
        return []
    return [f"{problem}; {cause}"]
