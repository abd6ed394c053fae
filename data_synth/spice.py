"""Responses of the same circuits by a transient run of ngspice, with a piecewise linear source."""

import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.changing import Course
from data_synth.drive import Drive, end_values
from data_synth.errors import RecipeError
from data_synth.network import Network, state_space

_JUMP = 1e-9  # s, duration of an ideal jump in ngspice
_POINTS = 32  # source points per step of a curved drive, 512 per cycle
_SETTLED = 16.0  # slowest time constants simulated before the steady state, which leaves 1e-7
_STILL = 1e-9  # fraction of the fastest rate below which a charge does not move
_STEPS = 4  # time steps per sample of the record
_LONG = 600  # s, limit of a run


def is_installed() -> bool:
    """Return whether ngspice is installed."""
    return shutil.which("ngspice") is not None


def ngspice_version() -> str:
    """Return the version that ngspice prints."""
    said = subprocess.run(["ngspice", "--version"], capture_output=True, text=True, timeout=60).stdout
    return next((word for word in said.split() if word.startswith("ngspice-")), "ngspice")


def spice_response(
    circuit: Network, law: Mapping[str, Any] | None, drive: Drive, time: np.ndarray, course: Course | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V, Vsc (V) and I (A) at `time` (s): periodic drives after many periods, others from rest.

    A changing finger is two equal skins and Ci, whose values follow voltage sources with the `course`.

    Raises:
        RecipeError: ngspice is not installed, failed, or does not support the skin.
    """
    if not is_installed():
        raise RecipeError("ngspice is not installed; install it (apt-get install ngspice), or use route = 'scipy'")
    begin = min(float(time.min()), 0.0)
    if drive.period:
        rates = -np.linalg.eigvalsh(state_space(circuit).A)
        slowest = np.min(rates[rates > _STILL * np.max(rates)])
        begin -= drive.period * np.ceil(_SETTLED / slowest / drive.period)
    end = float(time.max()) + 2.0 * _JUMP
    step = float(np.median(np.diff(np.unique(time)))) / _STEPS
    kept = max(float(time.min()) - begin - 2.0 * step, 0.0)
    skin = ",".join(str(node) for node in circuit.skin if node)
    deck = ["* a finger", f"Vdrive 99 0 PWL({_source_points(drive, begin, end)})", "Vmeter 99 1 0"]
    if course is None:
        deck += [f"{each.kind}{n} {each.start} {each.end} {each.value:.15g}" for n, each in enumerate(circuit.branches)]
    else:
        deck += _changing_sources(circuit, course, begin)
    deck += _nonlinear_sources(circuit, law)
    deck += [".options reltol=1e-6 abstol=1e-15 vntol=1e-9 trtol=1 method=gear", ".control"]
    deck += ["set wr_vecnames", "set wr_singlescale", "set numdgt=12"]
    deck += [f"tran {step:.12g} {end - begin:.15g} {kept:.15g} {step:.12g} uic"]
    deck += [f"wrdata out.txt v({circuit.voltage}) v({skin}) i(Vmeter)"]
    table = _run_ngspice([*deck, "quit", ".endc", ".end"], end - begin)
    # at a jump the record holds the value after it
    wanted = time - begin + (2.0 * _JUMP if drive.jumps else 0.0)
    voltage, Vsc, current = (np.interp(wanted, table[:, 0], table[:, column]) for column in (1, 2, 3))
    return voltage, Vsc, current


def _source_points(drive: Drive, begin: float, end: float) -> str:
    """Return times from `begin` on, and voltages, of the piecewise linear source."""
    corners = drive.corners(begin, end)
    corners = np.unique([begin, *corners[(corners > begin) & (corners < end)], end + _JUMP])
    if drive.degree > 1:
        fine = np.arange(begin, end, drive.longest / _POINTS)
        corners = np.unique(np.concatenate([corners, fine]))
        corners = corners[np.append(True, np.diff(corners) > 4.0 * _JUMP)]
    after, before = end_values(drive, corners)
    points = [(0.0, 0.0 if drive.period is None else after[0])]
    for time, left, right in zip(corners[:-1] - begin, [points[0][1], *before[:-1]], after, strict=True):
        points += [(time, left)] if time > 0.0 else []
        points += [(time + _JUMP, right)] if abs(right - left) > 1e-3 else []
    points.append((corners[-1] - begin, before[-1]))
    return "\n+ ".join(f"{time:.15g} {voltage:.12g}" for time, voltage in points)


def _changing_sources(circuit: Network, course: Course, begin: float, points: int = 400) -> list[str]:
    """Return the branches with the values of the start, and sources for what the course adds to current and charge."""
    time = np.unique(np.concatenate([[begin], course.time, np.linspace(course.time[0], course.time[-1], points)]))
    time = time[np.append(True, np.diff(time) > _JUMP)]
    values = dict(zip(("R", "outer", ""), course.values(time) ** [[-1.0], [1.0], [1.0]], strict=True))
    lines = []
    for n, each in enumerate(circuit.branches):
        across = f"v({each.start},{each.end})" if each.end else f"v({each.start})"
        value = values["R" if each.kind == "R" else each.layer]  # conductance or capacitance
        start = 1.0 / value[0] if each.kind == "R" else value[0]
        added = zip(time - begin, value / value[0] - 1.0, strict=True)
        table = "\n+ ".join(f"{t:.15g} {v:.12g}" for t, v in added)
        lines += [f"{each.kind}{n} {each.start} {each.end} {start:.15g}", f"Vadded{n} added{n} 0 PWL({table})"]
        if each.kind == "R":
            lines.append(f"B{n} {each.start} {each.end} I={across}*v(added{n})/{start:.15g}")
        else:  # the current into another capacitance with the added charge is repeated
            lines += [f"B{n} q{n} 0 V={across}*v(added{n})", f"Vq{n} q{n} p{n} 0", f"Cq{n} p{n} 0 {start:.15g}"]
            lines.append(f"F{n} {each.start} {each.end} Vq{n} 1")
    return lines


def _nonlinear_sources(circuit: Network, law: Mapping[str, Any] | None) -> list[str]:
    """Return current sources for the nonlinear current of a skin."""
    if law is None:
        return []
    if law["model"] != "nonlinear":
        raise RecipeError(f"[skin] model = '{law['model']}' is not available with ngspice; use route = 'scipy'")
    found = []
    for n, (start, end, R, _) in enumerate(circuit.layers):
        v = f"v({start},{end})" if end else f"v({start})"
        found.append(f"B{n} {start} {end} I={v}*{v}*{v}/{R * law['half_voltage'] ** 2:.15g}")
    return found


def _run_ngspice(deck: list[str], end: float) -> np.ndarray:
    """Run the deck and return its output table, which must reach `end` (s)."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "deck.cir").write_text("\n".join(deck) + "\n", encoding="utf-8")
        try:
            ran = subprocess.run(
                ["ngspice", "-b", "deck.cir"], cwd=folder, capture_output=True, text=True, timeout=_LONG
            )
        except subprocess.TimeoutExpired:
            raise RecipeError(f"ngspice took longer than {_LONG} s; record less, or use route = 'scipy'") from None
        out = Path(folder, "out.txt")
        table = np.loadtxt(out, skiprows=1) if out.exists() else np.empty((0, 4))
        if not table.size or table[-1, 0] < end * (1.0 - 1e-9):
            said = (ran.stderr.strip() or ran.stdout.strip() or "no reason given").splitlines()[-1]
            raise RecipeError(f"ngspice did not finish ({said}); use route = 'scipy'")
        return table
