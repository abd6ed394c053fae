"""Accuracy at the ends of the parameter range against mpmath: the sweep, the reference, a table of the worst points.

The points are part of the definition of the test: 2,100 from seed 20180 and the corners of the box, log-uniform in
Rsc 1 ohm to 1 Tohm, Csc 1 aF to 1 mF (every tenth: 0), Ci 1 aF to 1 uF, f 1 uHz to 1 GHz. The reference uses exactly
the same binary numbers as fitact. It solves one period with plain formulas and 220 digits, because differences cancel
up to 100 of them, and computes derivatives as central differences.

    python -m tests.extremes
"""

import concurrent.futures
import itertools
import multiprocessing
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from mpmath import mp, mpf

import fitact
from fitact.model.force import EPSILON_0

V0 = 180.0
DUTY, RISE, PHASES = 0.2, 0.01, 16
AREA, T_I, T_SC = 1e-4, 1e-6, 200e-6
EPS_I, EPS_SC = 3.9, 2000.0
DRIVES = ("sine", "square", "square, duty 0.2", "triangle", "trapezoid")
DIGITS = 220
TOLERANCE = {np.float64: 1e-12, np.float32: 1e-5}
GRADIENT_TOLERANCE = 1e-9
ENOUGH = 1200  # number of points compared
# a peak at t = (3/4) / f, if T / tau exceeds tolerance / eps: rounding of t decides how far behind it a sample lies
EDGES = {"triangle": (12,)}
NOISE = mpf(10) ** -150  # resolution of a difference quotient, relative to the peak
nan = mpf("nan")


def points(count: int = 2100) -> np.ndarray:
    """Return Rsc, Csc, Ci, f of each point, shape (points, 4)."""
    low, high = np.array([0.0, -18.0, -18.0, -6.0]), np.array([12.0, -3.0, -6.0, 9.0])
    box = 10.0 ** np.random.default_rng(20180).uniform(low, high, size=(count, 4))
    corners = 10.0 ** np.array(list(itertools.product(*zip(low, high, strict=True))))
    no_skin_capacitance = corners[corners[:, 1] < 1e-10]
    box[::10, 1] = no_skin_capacitance[:, 1] = 0.0
    return np.concatenate([box, corners, no_skin_capacitance])


# ------------------------------------------------------------------ fitact


def drive_of(name: str, f: jax.Array, rise_time: jax.Array) -> fitact.Sine:
    return {
        "sine": fitact.Sine(2.0 * V0, f),
        "square": fitact.Square(2.0 * V0, f),
        "square, duty 0.2": fitact.Square(2.0 * V0, f, duty=DUTY),
        "triangle": fitact.Triangle(2.0 * V0, f),
        "trapezoid": fitact.Trapezoid(2.0 * V0, f, rise_time),
    }[name]


def quantities(name: str) -> Callable[[jax.Array, jax.Array], dict[str, jax.Array]]:
    """Return the quantities at a point, with `logs` added to the logarithms of Rsc, Csc and Ci."""

    def evaluate(logs: jax.Array, point: jax.Array) -> dict[str, jax.Array]:
        R, C, Ci = (point[i] * jnp.exp(logs[i]) for i in range(3))
        f = point[3]
        circuit = fitact.FinalCircuit(R, C, Ci)
        if name == "transfer":
            omega = 2.0 * np.pi * f
            return {"amplitude": circuit.amplitude(omega), "phase": circuit.phase(omega)}
        drive = drive_of(name, f, point[4])
        fixed = fitact.Contact(AREA, T_I, EPS_I, T_SC, EPS_SC)
        own = fitact.Contact.from_capacitances(Ci, C, AREA, T_I, T_SC)
        return {
            "mean force": fitact.mean_force(circuit, drive, fixed),
            "peak force": fitact.peak_force(circuit, drive, fixed),
            "mean force, eps from C": fitact.mean_force(circuit, drive, own),
            "peak force, eps from C": fitact.peak_force(circuit, drive, own),
            "waveform": fitact.response(circuit, drive, jnp.arange(PHASES) / PHASES / f),
        }

    return evaluate


def ours(name: str, rows: np.ndarray, gradients: bool) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    evaluate = quantities(name)
    zero = jnp.zeros(3, rows.dtype)
    values = jax.jit(jax.vmap(evaluate, (None, 0)))(zero, rows)
    slopes = jax.jit(jax.vmap(jax.jacrev(evaluate), (None, 0)))(zero, rows) if gradients else {}
    return {k: np.asarray(v) for k, v in values.items()}, {k: np.asarray(v) for k, v in slopes.items()}


# ------------------------------------------------------------------ mpmath


def straight(name: str, rise: mpf) -> list[tuple[mpf, mpf, mpf]]:
    """Return (fraction of the period, start, end) of each linear piece of a waveform of amplitude 1."""
    one = mpf(1)
    if name == "triangle":
        return [(one / 4, mpf(0), one), (one / 2, one, -one), (one / 4, -one, mpf(0))]
    if name == "trapezoid":
        high = one / 2 - rise
        return [(rise, -one, one), (high, one, one), (rise, one, -one), (high, -one, -one)]
    return [(one / 2, one, one), (one / 2, -one, -one)]


def periodic(pieces: list[tuple[mpf, mpf, mpf]], x: mpf) -> tuple[mpf, mpf, list[mpf]]:
    """Return mean square, peak and waveform of the high-pass response to linear pieces; x = T / tau."""
    decays = [mp.exp(-share * x) for share, _, _ in pieces]
    slopes = [(end - start) / (share * x) for share, start, end in pieces]  # limit that u approaches
    jumps = [start - before[2] for (_, start, _), before in zip(pieces, [pieces[-1], *pieces[:-1]], strict=True)]

    def around(u: mpf) -> mpf:
        for k, (decay, slope) in enumerate(zip(decays, slopes, strict=True)):
            u = slope + (u - slope) * decay + jumps[(k + 1) % len(pieces)]
        return u

    whole = mp.exp(-x)
    u = around(mpf(0)) / (1 - whole)
    mean, peak, begin, wave, phase = mpf(0), mpf(0), mpf(0), [], 0
    sixteenth = mp.exp(-x / PHASES)
    powers = [mpf(1)]
    for _ in range(PHASES):
        powers.append(powers[-1] * sixteenth)
    for k, ((share, _, _), decay, slope) in enumerate(zip(pieces, decays, slopes, strict=True)):
        at_start = mp.exp(begin * x)
        while phase < PHASES and (mpf(phase) / PHASES < begin + share or k == len(pieces) - 1):
            wave.append(slope + (u - slope) * powers[phase] * at_start)
            phase += 1
        away = u - slope
        mean += share * slope**2 + 2 * slope * away * (1 - decay) / x + away**2 * (1 - decay**2) / (2 * x)
        after = slope + away * decay
        peak = max(peak, abs(u), abs(after))
        begin, u = begin + share, after + jumps[(k + 1) % len(pieces)]
    return mean, peak, wave


def highpass(name: str, point: tuple[mpf, ...], duty: mpf, x: mpf) -> tuple[mpf, mpf, list[mpf]]:
    """Return mean square, peak and waveform of s tau / (1 + s tau) for a drive of amplitude 1; x = T / tau."""
    if name == "sine":
        w = 2 * mp.pi / x
        squared = w**2 / (1 + w**2)
        angles = SINES
        return squared / 2, mp.sqrt(squared), [squared * s + squared / w * c for s, c in angles]
    if name == "square, duty 0.2":
        pieces = [(duty, mpf(1), mpf(1)), (1 - duty, mpf(-1), mpf(-1))]
    else:
        pieces = straight(name, point[4] * point[3])
    return periodic(pieces, x)


with mp.workdps(DIGITS):
    SINES = [(mp.sin(2 * mp.pi * k / PHASES), mp.cos(2 * mp.pi * k / PHASES)) for k in range(PHASES)]


class Truth(NamedTuple):
    """Quantity with its derivatives by log Rsc, log Csc and log Ci; a waveform has one set per phase."""

    value: list[mpf]
    slope: list[list[mpf]]
    scale: mpf  # scale of the errors of the value


def chain(value: mpf, by_g: mpf, by_b: mpf, r: mpf) -> list[mpf]:
    """Return d/dlog(Rsc, Csc, Ci) from d/dlog g and d/dlog b; r = Csc / (2 Ci + Csc)."""
    return [by_b, r * (by_b - by_g), r * by_g + (1 - r) * by_b]


def truth(name: str, row: np.ndarray, gradients: bool) -> dict[str, Truth]:
    """Return all quantities at one point, from the binary numbers in `row`."""
    kind = row.dtype.type
    point = tuple(mpf(float(v)) for v in row)
    R, C, Ci, f = point[:4]
    both = 2 * Ci + C
    g, b, r = Ci / both, R * both, C / both
    if name == "transfer":
        w = 2 * mp.pi * f * b
        amplitude, phase = g * w / mp.sqrt(1 + w**2), mp.atan2(1, w)
        return {
            "amplitude": Truth([amplitude], [chain(amplitude, amplitude, amplitude / (1 + w**2), r)], amplitude),
            "phase": Truth([phase], [chain(phase, mpf(0), -w / (1 + w**2), r)], phase),
        }
    duty, x = mpf(float(kind(DUTY))), 1 / (f * b)
    mean, peak, wave = highpass(name, point, duty, x)
    mean_b, peak_b, wave_b = mpf(0), mpf(0), [mpf(0)] * PHASES
    left = wave
    if gradients:
        h = mpf(10) ** -40
        up, down = (highpass(name, point, duty, x * factor) for factor in (1 - h, 1 + h))  # b is 1 / x
        mean_b, peak_b = (up[0] - down[0]) / (2 * h), (up[1] - down[1]) / (2 * h)
        wave_b = [(high - low) / (2 * h) for high, low in zip(up[2], down[2], strict=True)]
        if abs(peak_b) < NOISE * peak:
            peak_b = mpf(0)
        wave_b = [d if abs(d) > NOISE * peak else mpf(0) for d in wave_b]
        left = [u if abs(u) > NOISE * peak else mpf(0) for u in wave]
    skipped = EDGES.get(name, ()) if x * float(np.finfo(kind).eps) > TOLERANCE[kind] else ()
    return forces(point, kind, g, r, (mean, mean_b), (peak, peak_b)) | {
        "waveform": Truth(
            [nan if k in skipped else V0 * g * u for k, u in enumerate(wave)],
            [
                [nan] * 3 if k in skipped else chain(u, V0 * g * u, V0 * g * d, r)
                for k, (u, d) in enumerate(zip(left, wave_b, strict=True))
            ],
            V0 * g * peak,
        )
    }


def forces(
    point: tuple[mpf, ...], kind: type, g: mpf, r: mpf, mean: tuple[mpf, mpf], peak: tuple[mpf, mpf]
) -> dict[str, Truth]:
    """Return the mean and peak force of both contacts, from the mean square and peak of u with their d/dlog b."""
    area, t_i, t_sc, eps_i, eps_sc, eps0 = (mpf(float(kind(v))) for v in (AREA, T_I, T_SC, EPS_I, EPS_SC, EPSILON_0))
    _, C, Ci, *_ = point
    fixed = eps0 * area / (2 * (t_i / eps_i + t_sc / eps_sc) * (t_i + t_sc))
    own = Ci * C / (Ci + C) / (2 * (t_i + t_sc))
    share = C / (Ci + C)
    found = {}
    for label, square, by_b in (("mean", *mean), ("peak", peak[0] ** 2, 2 * peak[0] * peak[1])):
        square, by_b = V0**2 * g**2 * square, V0**2 * g**2 * by_b
        slope = chain(square, 2 * square, by_b, r)
        found[f"{label} force"] = Truth([fixed * square], [[fixed * s for s in slope]], fixed * square)
        extra = [mpf(0), 1 - share, share]
        found[f"{label} force, eps from C"] = Truth(
            [own * square],
            [[own * (s + square * e) for s, e in zip(slope, extra, strict=True)]],
            own * square,
        )
    return found


# ------------------------------------------------------------------ the comparison


class Worst(NamedTuple):
    """Largest error of a quantity, and its point."""

    error: float
    point: np.ndarray
    compared: int


def errors(name: str, rows: np.ndarray, gradients: bool) -> Iterator[tuple[str, str, Worst]]:
    """Return the worst error of every value and gradient of one drive; infinite if a result is not finite.

    Values of a waveform are relative to the peak of the period, its gradients to the largest component over the
    period. Numbers outside the normal range do not count, nor does a gradient within 1e10 of its ends.
    """
    values, slopes = ours(name, rows, gradients)
    smallest = mpf(float(np.finfo(rows.dtype).tiny))
    worst: dict[tuple[str, str], Worst] = {}
    for i, row in enumerate(rows):
        for quantity, (value, slope, scale) in truth(name, row, gradients).items():
            pairs = [("value", values[quantity][i], value, scale)]
            if gradients:
                flat = [s for one in slope for s in one]
                pairs.append(("gradient", slopes[quantity][i], flat, max(abs(s) for s in flat if s == s)))
            for what, computed, exact, scale in pairs:
                if not np.all(np.isfinite(computed)):
                    error = np.inf
                elif scale < smallest * (1e10 if what == "gradient" else 1):
                    continue
                else:
                    both = zip(np.ravel(computed), exact, strict=True)
                    error = float(max(abs(mpf(float(c)) - e) for c, e in both if e == e) / scale)
                before = worst.get((quantity, what), Worst(-1.0, row, 0))
                here = Worst(error, row, before.compared + 1)
                worst[quantity, what] = here if error > before.error else before._replace(compared=here.compared)
    for (quantity, what), found in worst.items():
        yield quantity, what, found


def rows_for(kind: type) -> np.ndarray:
    """Return the points and the rise time of the trapezoid, in the requested precision."""
    rows = points().astype(kind)
    return np.column_stack([rows, (RISE / rows[:, 3]).astype(kind)])


def sweep(
    kind: type, names: tuple[str, ...] = ("transfer", *DRIVES), every: int = 1
) -> Iterator[tuple[str, str, str, Worst]]:
    """Yield (drive, quantity, value or gradient, worst) over the whole box; gradients only in double precision."""
    with jax.enable_x64(kind is np.float64), mpmath.workdps(DIGITS):
        for name in names:
            for quantity, what, worst in errors(name, rows_for(kind)[::every], kind is np.float64):
                yield name, quantity, what, worst


def allowed(kind: type, what: str) -> float:
    """Return the largest error that the documentation promises."""
    return TOLERANCE[kind] if what == "value" else GRADIENT_TOLERANCE


def main() -> None:
    """Print the table; the exit status is 1 if an error is larger than promised."""
    bad = False
    print(f"{'drive':18}{'quantity':24}{'':10}{'dtype':9}{'worst':>9}{'points':>8}   Rsc ohm, Csc F, Ci F, f Hz")
    kinds, names = (np.float64, np.float32), ("transfer", *DRIVES)
    jobs = [(kind, name) for kind in kinds for name in names]
    with concurrent.futures.ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for (kind, _), rows in zip(jobs, pool.map(_sweep_one, jobs), strict=True):
            for name, quantity, what, worst in rows:
                where = ", ".join(f"{v:.3g}" for v in worst.point[:4])
                print(
                    f"{name:18}{quantity:24}{what:10}{kind.__name__:9}{worst.error:9.1e}{worst.compared:8}   {where}",
                    flush=True,
                )
                bad = bad or worst.error > allowed(kind, what) or worst.compared < ENOUGH
    raise SystemExit(bad)


def _sweep_one(job: tuple[type, str]) -> list[tuple[str, str, str, Worst]]:
    kind, name = job
    return list(sweep(kind, (name,)))


if __name__ == "__main__":
    main()
