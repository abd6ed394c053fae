"""Chain on disk, from which sampling resumes, in the layout of emcee's HDF5 backend."""

import dataclasses
from pathlib import Path
from typing import Any, Self

import emcee
import h5py
import numpy as np
from jaxtyping import Float, Int

from fitact.errors import InputError
from fitact.files import atomic_write


@dataclasses.dataclass
class Chain:
    """All steps of several ensembles."""

    names: tuple[str, ...]  # names of the coordinates
    fingerprint: str  # hash of the inputs that the chain belongs to
    points: Float[np.ndarray, "ensembles steps walkers n"]  # positions of every walker at every step
    log_prob: Float[np.ndarray, "ensembles steps walkers"]  # log-probabilities of the points
    accepted: Int[np.ndarray, "ensembles walkers"]  # number of accepted moves of each walker
    states: tuple[emcee.State, ...]  # last state of each ensemble, including its random number generator
    seconds: float = 0.0  # run time of the sampling so far

    @classmethod
    def empty(cls, names: tuple[str, ...], fingerprint: str, states: list[emcee.State]) -> Self:
        """Return a chain without steps."""
        walkers, size = states[0].coords.shape
        points = np.empty((len(states), 0, walkers, size))
        accepted = np.zeros((len(states), walkers), dtype=int)
        return cls(names, fingerprint, points, points[..., 0], accepted, tuple(states))

    @property
    def steps(self) -> int:
        """Number of steps of each ensemble."""
        return self.points.shape[1]

    def thinning_slice(self, burn: int, n_points: int) -> slice:
        """Return equally spaced steps from the burn-in to the last, with about `n_points` points per ensemble."""
        n_steps = self.steps - burn
        spacing = max(1, round(n_steps * self.points.shape[2] / n_points))
        return slice(burn + (n_steps - 1) % spacing, None, spacing)

    def extend(self, new_steps: list[tuple[np.ndarray, np.ndarray, emcee.State, np.ndarray]]) -> None:
        """Append the points, log-probabilities, last state and accepted moves of every ensemble."""
        points, log_prob, states, accepted = zip(*new_steps, strict=True)
        self.points = _append_steps(self.points, np.stack(points))
        self.log_prob = _append_steps(self.log_prob, np.stack(log_prob))
        self.accepted = self.accepted + np.stack(accepted).astype(int)
        self.states = states

    def save(self, path: Path) -> None:
        """Write the chain; `emcee.backends.HDFBackend(path, name="ensemble_0")` opens its first ensemble."""
        with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
            file.attrs["fingerprint"] = self.fingerprint
            file.attrs["names"] = list(self.names)
            file.attrs["seconds"] = self.seconds
            for index, state in enumerate(self.states):
                group = file.create_group(f"ensemble_{index}")
                walkers, size = state.coords.shape
                described: dict[str, Any] = {
                    "version": emcee.__version__,
                    "nwalkers": walkers,
                    "ndim": size,
                    "has_blobs": False,
                    "iteration": self.steps,
                }
                described |= {f"random_state_{i}": part for i, part in enumerate(state.random_state)}
                group.attrs.update(described)
                group["chain"] = self.points[index]
                group["log_prob"] = self.log_prob[index]
                group["accepted"] = self.accepted[index].astype(float)

    @classmethod
    def load(cls, path: Path, fingerprint: str) -> Self:
        """Read the chain of `fingerprint`; raise InputError for a chain of other inputs, or another file."""
        try:
            with h5py.File(path, "r") as file:
                if file.attrs["fingerprint"] != fingerprint:
                    raise InputError(
                        f"{path}: this chain belongs to another record, scene, seed, tolerance or version of fitact;"
                        " remove the file or choose another output folder"
                    )
                groups = [file[f"ensemble_{i}"] for i in range(len(file))]
                states = []
                for group in groups:
                    random = tuple(group.attrs[f"random_state_{i}"] for i in range(5))
                    states.append(emcee.State(group["chain"][-1], log_prob=group["log_prob"][-1], random_state=random))
                return cls(
                    tuple(str(name) for name in file.attrs["names"]),
                    fingerprint,
                    np.stack([group["chain"][:] for group in groups]),
                    np.stack([group["log_prob"][:] for group in groups]),
                    np.stack([group["accepted"][:] for group in groups]).astype(int),
                    tuple(states),
                    float(file.attrs["seconds"]),
                )
        except (OSError, KeyError) as error:
            raise InputError(f"{path}: not a chain written by fitact ({error}); remove the file") from error


def _append_steps(steps: Float[np.ndarray, "ensembles steps ..."], new_steps: np.ndarray) -> np.ndarray:
    """Concatenate along the steps; the result is a view of a larger buffer, so that few calls copy the chain."""
    count, buffer = steps.shape[1] + new_steps.shape[1], steps.base
    if buffer is None or buffer.shape[0] != steps.shape[0] or buffer.shape[1] < count:
        buffer = np.empty((steps.shape[0], 2 * count, *steps.shape[2:]))
        buffer[:, : steps.shape[1]] = steps
    buffer[:, steps.shape[1] : count] = new_steps
    return buffer[:, :count]
