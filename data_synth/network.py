"""The circuit as a network of resistors and capacitors, and its state space by nodal analysis."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

EPS0 = 8.85e-12  # F/m, the reference paper's value
_EMPTY = 1e-10  # fraction of the largest capacitance below which a node counts as having none


class Branch(NamedTuple):
    """Resistor (ohm) or capacitor (F) between two nodes; node 0 is ground, node 1 the drive."""

    kind: str  # R or C
    start: int
    end: int
    value: float
    layer: str = ""  # "outer" for the skin layer that depends on frequency or voltage


class Network(NamedTuple):
    """Branches, the two nodes of Vsc, for each outer skin layer its nodes, R (ohm) and C (F), and the node of V."""

    branches: tuple[Branch, ...]
    skin: tuple[int, int]
    layers: tuple[tuple[int, int, float, float], ...]
    voltage: int = 1


class StateSpace(NamedTuple):
    """State space x' = A x + B u, y = C x + D u + E dV/dt.

    u: V of the drive (V), and the nonlinear current of each outer layer (A).
    y: V, Vsc (V) and I (A) as recorded, the voltage of each outer layer (V).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    E: np.ndarray


def network(
    scene: Mapping[str, Mapping[str, Any]], second: tuple[float, float] | None = None, behind: bool = False
) -> Network:
    """Return the scene's circuit from drive to ground; `second` is R (ohm) and C (F) of a deeper layer in each skin.

    behind: whether V is recorded behind the series resistor, where the rest of the loop begins.
    """
    skin, measured = scene["skin"], scene["measurement"]
    touching = [(skin["Rsc"], skin["Csc"], "outer"), *([(*second, "")] if second else [])]
    before = [
        (measured["series_resistor"], None, ""),
        (scene["device"]["Ri"], scene["device"]["Ci"], ""),
        (*_gap(scene), ""),
    ]
    before, after = (list(filter(_has_impedance, part)) for part in (before, _ground_elements(scene, second)))
    branches = []
    for node, (R, C, layer) in enumerate([*before, *touching, *after]):
        start, end = node + 1, node + 2
        if end == len(before) + len(touching) + len(after) + 1:
            end = 0
        branches += [Branch("R", start, end, R, layer)] if R else []
        branches += [Branch("C", start, end, C, layer)] if C else []
    first = len(before) + 1
    last = first + len(touching) if after else 0
    probe = (("R", measured["probe_resistance"]), ("C", measured["probe_capacitance"]))
    branches += [Branch(kind, first, last, value) for kind, value in probe if value]
    if measured["stray_capacitance"] and measured["current_lead"] == "drive":
        branches.append(Branch("C", 1, 0, measured["stray_capacitance"]))
    outer = [(R, C) for R, C in itertools.pairwise(branches) if R.layer and R.kind == "R"]
    layers = tuple((R.start, R.end, R.value, C.value) for R, C in outer)
    return Network(tuple(branches), (first, last), layers, 2 if behind else 1)


def _has_impedance(part: tuple[float | None, float | None, str]) -> bool:
    return bool(part[0] or part[1])


def _gap(scene: Mapping[str, Mapping[str, Any]]) -> tuple[float | None, float | None]:
    gap = scene["gap"]
    air = EPS0 * scene["device"]["contact_area"] / gap["thickness"] if gap["thickness"] else None
    return gap["resistance"], gap["capacitance"] or air


def _ground_elements(scene: Mapping[str, Mapping[str, Any]], second: tuple[float, float] | None) -> Iterator[tuple]:
    """Yield the elements between the touching skin and ground, in series."""
    ground, skin = scene["grounding"], scene["skin"]
    if ground["connection"] == "natural":
        yield ground["Z"], ground["Z_capacitance"], ""
        return
    yield ground["R_H"], None, ""
    yield ground["grounding_Rsc"] or skin["Rsc"], ground["grounding_Csc"] or skin["Csc"], "outer"
    if second:
        yield *second, ""


def _incidence(pairs: list[tuple[int, int]], size: int) -> np.ndarray:
    """Return the incidence matrix: per pair a column with 1 at its start and -1 at its end, without the ground row."""
    found = np.zeros((size + 1, len(pairs)))
    for column, (start, end) in enumerate(pairs):
        found[start, column] += 1.0
        found[end, column] -= 1.0
    return found[1:]


def _size(circuit: Network) -> int:
    return max(max(each.start, each.end) for each in circuit.branches)


def state_space(circuit: Network) -> StateSpace:
    """Return the state space by nodal analysis: c x' + g x = 0 at every node except the drive (row and column 0).

    The states are the combinations of free nodes that capacitances hold, relative to the drive's instantaneous
    contribution; nodes without capacitance follow from Kirchhoff's current law.
    """
    size = _size(circuit)
    g, c = np.zeros((size, size)), np.zeros((size, size))
    for each in circuit.branches:
        ends = _incidence([(each.start, each.end)], size)
        if each.kind == "R":
            g += ends @ ends.T / each.value
        else:
            c += ends @ ends.T * each.value
    # the nonlinear current of an outer layer flows from its start to its end
    extra = _incidence([(start, end) for start, end, *_ in circuit.layers], size)
    values, vectors = np.linalg.eigh(c[1:, 1:])
    held = values > _EMPTY * values[-1]
    P, N = vectors[:, held] / np.sqrt(values[held]), vectors[:, ~held]  # P^T c P = 1
    at_once = P @ (P.T @ c[1:, 0])  # free nodes = z - at_once V
    source = np.column_stack([g[1:, 0] - g[1:, 1:] @ at_once, extra[1:]])
    # z = P x + N w, and N w from the nodes without capacitance
    follow = -N @ np.linalg.solve(N.T @ g[1:, 1:] @ N, N.T) if N.shape[1] else np.zeros((size - 1, size - 1))
    rest = np.eye(size - 1) + follow @ g[1:, 1:]
    A, B = -P.T @ g[1:, 1:] @ rest @ P, -P.T @ (g[1:, 1:] @ follow + np.eye(size - 1)) @ source
    nodes_x, nodes_u = rest @ P, follow @ source
    nodes_u[:, 0] -= at_once
    across = [(circuit.voltage, 0), circuit.skin, *((start, end) for start, end, *_ in circuit.layers)]
    voltages = _incidence(across, size)
    C = np.vstack([voltages[1:].T @ nodes_x, c[0, 1:] @ nodes_x @ A + g[0, 1:] @ nodes_x])
    D = np.vstack([voltages[1:].T @ nodes_u, c[0, 1:] @ nodes_x @ B + g[0, 1:] @ nodes_u])
    D[:-1, 0] += voltages[0]
    D[-1] += np.append(g[0, 0], extra[0])
    E = np.zeros(len(D))
    E[-1] = c[0, 1:] @ nodes_u[:, 0] + c[0, 0]
    E[np.abs(E) < _EMPTY * values[-1]] = 0.0
    order = [0, 1, len(D) - 1, *range(2, len(D) - 1)]
    return StateSpace(A, B, C[order], D[order], E[order])


def gains(circuit: Network, omega: np.ndarray, admittance: Callable[[Branch, np.ndarray], np.ndarray]) -> np.ndarray:
    """Return V, Vsc (1) and I (S) per volt of the drive, (3, frequencies), with the admittance (S) of each branch.

    omega: angular frequencies, rad/s.
    """
    size = _size(circuit)
    Y = np.zeros((omega.size, size, size), dtype=complex)
    for each in circuit.branches:
        ends = _incidence([(each.start, each.end)], size)
        Y += admittance(each, omega)[:, None, None] * (ends @ ends.T)
    free = np.linalg.solve(Y[:, 1:, 1:], -Y[:, 1:, :1])[..., 0]
    nodes = np.concatenate([np.ones((omega.size, 1)), free], axis=1)
    voltages = nodes @ _incidence([(circuit.voltage, 0), circuit.skin], size)
    return np.vstack([voltages.T, np.einsum("ni,ni->n", Y[:, 0], nodes)])


def plain_admittance(branch: Branch, omega: np.ndarray) -> np.ndarray:
    """Return the admittance (S) of a resistor or capacitor."""
    return 1j * omega * branch.value if branch.kind == "C" else np.full(omega.shape, 1.0 / branch.value, dtype=complex)
