"""The smallest drive that a given fraction of fingers feel: by waveform, frequency and insulator, within stated limits.

Vsc is linear in the drive and the force is quadratic in Vsc. One response at 1 Vpp thus gives the amplitude that a
finger needs.
"""

import dataclasses
import functools
import os
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitact.compiled import double_precision, jit
from fitact.design.drive_design import DriveDesign
from fitact.design.drive_option import DriveOption, normalize_drive
from fitact.design.drive_people import LAWS, FingerSample
from fitact.errors import InputError
from fitact.model.circuit import RC
from fitact.model.drive import Periodic
from fitact.model.force import Geometry
from fitact.model.skin import with_values
from fitact.model.steady_cycle import PeriodQuantities, Sensation, period_quantities, sensation
from fitact.populations.population import Population
from fitact.populations.population_draws import PopulationDraws
from fitact.scene.scene import Scene

WAVEFORMS = ("sine", "triangle", "square", "trapezoid")


def design_drive(
    scene: Scene,
    people: Population | FingerSample | str | os.PathLike[str] | None = None,
    share: float = 0.95,
    *,
    touches: float = 0.9,
    seed: int = 0,
) -> DriveDesign:
    """Find the smallest amplitude at which a fraction `share` of fingers feel the drive on the scene's panel.

    The scene's `[perception]` states the threshold, for the alternating part of the force: the amplitude of the sine
    with the same root mean square, or a table of thresholds for the friction's harmonics, see `Sensation`. Sine,
    triangle and square, the trapezoid if the scene has a rise time, and the scene's own drive are compared in the
    steady state. A drive's offset scales with it. No probe is connected.

    Args:
        scene: panel, drive, threshold and, in `[device]`, the limits to keep.
        people: fingers that are to feel it. A population, or the folder that `fitact population` left, gives Rsc, Csc
            and Ci; all else is the scene's. None means the scene's prior, which does not separate variability between
            fingers from lack of knowledge.
        share: fraction of fingers, or of people where the population has repetitions, from 0.01 to 0.99.
        touches: fraction of the touches in which each of them feels it, where the population has repetitions.
        seed: the same seed gives the same fingers.

    Raises:
        InputError: the scene states no threshold, or none at a frequency of the force; its drive is measured or has no
            steady state; its skin depends on the frequency; `share` or `touches` is out of range; a folder holds no
            population.
    """
    require_designable(scene, share, touches)
    unloaded = scene.measurement.model_copy(update={"probe_resistance": None, "probe_capacitance": None})
    scene = scene.model_copy(update={"measurement": unloaded})
    if people is None:
        people = FingerSample.from_prior(scene, seed)
    elif isinstance(people, Population):
        people = FingerSample.from_population(PopulationDraws.from_population(people, LAWS), scene, seed)
    elif not isinstance(people, FingerSample):
        people = FingerSample.from_population(PopulationDraws.from_folder(people, LAWS), scene, seed)
    bench, device = _DriveEvaluator(scene, people, share, touches), scene.device
    own, here = scene.drive.waveform, scene.drive.lowest_frequency
    names = [name for name in WAVEFORMS if name != "trapezoid" or scene.drive.rise_time is not None]
    tried = {name: bench.evaluate(name, here) for name in dict.fromkeys([*names, own])}
    if all(option.outside is not None and option.strongest is None for option, _ in tried.values()):
        assert scene.perception.thresholds is not None
        raise InputError(
            f"scene: [drive] frequency: the force of a drive at {here:g} Hz has no frequency in the table of thresholds"
            f" ({scene.perception.thresholds.range_text}); a force alternates at multiples of twice the frequency,"
            " or of the frequency with an offset"
        )
    frequencies = np.geomspace(10.0, 1000.0, 9).tolist()  # Hz, where touch is sensitive
    ratios = np.geomspace(0.01, 10.0, 13).tolist()  # over the scene's thickness, as in Fig. 12 of the reference paper
    return DriveDesign(
        scene,
        people,
        share,
        touches if people.touches > 1 else None,
        options={name: option for name, (option, _) in tried.items()},
        needed={name: needed for name, (_, needed) in tried.items()},
        by_frequency={
            name: tuple(bench.evaluate(name, f)[0] for f in frequencies if bench.has_room(name, f)) for name in tried
        },
        by_thickness=tuple(
            bench.evaluate(own, here, thickness=device.insulator_thickness * ratio)[0] for ratio in ratios
        ),
        by_permittivity=tuple(
            bench.evaluate(own, here, permittivity=permittivity)[0] for permittivity in (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
        ),
        seed=seed,
    )


class _DriveEvaluator(NamedTuple):
    """Evaluator of drives and insulators for the fingers drawn."""

    scene: Scene
    people: FingerSample
    share: float
    touches: float

    def evaluate(
        self, waveform: str, frequency: float, *, thickness: float | None = None, permittivity: float | None = None
    ) -> tuple[DriveOption, Float[np.ndarray, "laws fingers"]]:
        """Evaluate a drive on an insulator (m, relative; default: the scene's), and each finger's amplitude, V."""
        own = self.scene.device
        thickness = own.insulator_thickness if thickness is None else thickness
        permittivity = own.insulator_permittivity if permittivity is None else permittivity
        # eq. (3) gives the ratio of Ci only, because the Ci of the scene or the fingers need not follow it
        ratio = permittivity / own.insulator_permittivity * (own.insulator_thickness / thickness)
        layer = {"insulator_thickness": thickness, "insulator_permittivity": permittivity, "Ci": ratio * own.Ci}
        device = own.model_copy(update=layer)
        drive = normalize_drive(self.scene.drive).model_copy(update={"waveform": waveform}).make()
        assert isinstance(drive, Periodic)
        drive = eqx.tree_at(lambda wave: wave.frequency, drive, frequency)
        quantities, felt = self._unit_quantities(drive, thickness, ratio)
        needed = self.people.reduce_touches(_required_amplitudes(self.scene, quantities, felt), self.touches)
        return DriveOption.from_amplitudes(waveform, frequency, device, needed, quantities, self.share, felt), needed

    def has_room(self, waveform: str, frequency: float) -> bool:
        """Return whether the period has room for both edges."""
        drive = self.scene.drive
        return waveform != "trapezoid" or (drive.rise_time or 0.0) < min(drive.duty, 1.0 - drive.duty) / frequency

    def _unit_quantities(
        self, drive: Periodic, thickness: float, ratio: float
    ) -> tuple[PeriodQuantities, Sensation | None]:
        """Compute the effects of 1 Vpp on each finger, with its Ci times `ratio`: arrays (laws, fingers)."""
        flat = {name: values.reshape(-1) for name, values in self.people.values.items()}
        flat["Ci"] = ratio * flat["Ci"]
        leak = flat.get("Ri", self.scene.nominal_values()["Ri"])
        if leak is not None:  # eq. (4), for an insulator of the same resistivity
            thicker = thickness / self.scene.device.insulator_thickness
            flat["Ri"] = np.broadcast_to(thicker * np.asarray(leak), flat["Ci"].shape)
        template = self.scene.make_rc_circuit({name: values[0] for name, values in flat.items()})
        geometry = dataclasses.replace(self.scene.geometry(), insulator_thickness=thickness)
        table, coefficient = self.scene.perception.thresholds, float(self.scene.friction.coefficient)
        sensitivity = table and table.harmonic_sensitivity(float(np.asarray(drive.frequency)), coefficient)
        with double_precision():
            effects = _map_fingers(*jax.tree.map(jnp.asarray, (template, geometry, drive, flat, sensitivity)))
            return jax.tree.map(lambda x: np.asarray(x).reshape(*self.people.shape, *x.shape[1:]), effects)


@functools.partial(jit, fast=True)
def _map_fingers(
    template: RC,
    geometry: Geometry,
    drive: Periodic,
    values: dict[str, Float[Array, " fingers"]],
    sensitivity: Float[Array, " harmonics"] | None,
) -> tuple[PeriodQuantities, Sensation | None]:
    def evaluate_finger(finger_values: dict[str, Array]) -> tuple[PeriodQuantities, Sensation | None]:
        circuit = with_values(template, finger_values)
        assert isinstance(circuit, RC)
        contact = geometry.contact(circuit)
        felt = None if sensitivity is None else sensation(circuit, drive, contact, sensitivity)
        return period_quantities(circuit, drive, contact), felt

    return jax.lax.map(evaluate_finger, values, batch_size=64)  # whose responses fit in the processor's cache


def _required_amplitudes(
    scene: Scene, unit_quantities: PeriodQuantities, felt: Sensation | None
) -> Float[np.ndarray, "laws fingers"]:
    """Return the peak-to-peak amplitude (V) at which each finger feels a drive with these effects at 1 Vpp."""
    alternating, perception = np.asarray(unit_quantities.force_alternating), scene.perception
    with np.errstate(divide="ignore"):
        if felt is not None:
            return np.sqrt(1.0 / np.asarray(felt.times_threshold))
        if perception.threshold_force is not None:
            return np.sqrt(perception.threshold_force / alternating)
        assert perception.friction_change is not None  # one of the three is required
        # alternating A^2 = change (mean A^2 + fN) has no solution if the mean force rises too fast
        reachable = np.maximum(alternating - perception.friction_change * np.asarray(unit_quantities.force_mean), 0.0)
        return np.sqrt(perception.friction_change * scene.friction.normal_force / reachable)


def require_designable(scene: Scene, share: float, touches: float) -> None:
    """Refuse a scene or share that no drive can be designed for; raises as `design_drive`."""
    perception, drive = scene.perception, scene.drive
    if not 0.01 <= share <= 0.99:  # beyond, the answer is the assumed tail of the distribution
        raise InputError(f"share = {share:g}: give a fraction of fingers from 0.01 to 0.99, such as 0.95")
    if not 0.01 <= touches <= 0.99:
        raise InputError(f"touches = {touches:g}: give a fraction of touches from 0.01 to 0.99, such as 0.9")
    if all(each is None for each in (perception.threshold_force, perception.friction_change, perception.thresholds)):
        raise InputError(
            "scene: [perception] must state a threshold, because fitact knows no generally valid one; write"
            " threshold_force = '...' or friction_change = ..., and its source, or thresholds = 'file.csv'"
        )
    if perception.friction_change is not None and scene.friction.normal_force == 0.0:
        raise InputError(
            "scene: without [friction] normal_force the change of friction does not depend on the amplitude; give one,"
            " or [perception] threshold_force instead"
        )
    if drive.waveform in ("measured", "burst", "chirp") or not drive.steady_state:
        state = f"waveform = '{drive.waveform}'" if drive.steady_state or drive.waveform != "square" else "steady_state"
        raise InputError(
            f"scene: [drive] {state}: a drive is designed in the steady state; state a sine, triangle, square,"
            " trapezoid or multitone"
        )
    if scene.skin.level != "constant":
        raise InputError(
            f"scene: [skin] level = '{scene.skin.level}': a drive is designed for constant skins; write level ="
            " 'constant', with Rsc and Csc at the drive's frequency"
        )
