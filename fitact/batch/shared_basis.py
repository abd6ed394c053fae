"""Records with one drive and one time grid, in common coordinates.

One `fitact.likelihood.compression.Compression` serves all of them, and one map from samples to its coordinates, so that
a record costs one product with a matrix of some thirty columns.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.compiled import jit, pad_samples
from fitact.likelihood.compression import BASELINE_NAMES, Compression, split_functions
from fitact.likelihood.projection import RANK_TOLERANCE, TableNodes, assemble_compression, evaluate_functions
from fitact.model.circuit import HighpassTerms
from fitact.model.drive import Drive
from fitact.model.response_table import chebyshev, round_up_column_count


class SharedBasis(NamedTuple):
    """Orthonormal functions over the samples, the first of which span the responses around a central time constant.

    Attributes:
        functions: values at the samples.
        compression: compression of a record that is 0; for another, `observed` is a row of `project`.
        clock: first-order effect of a clock error on the record, in the coordinates.
    """

    functions: Float[np.ndarray, "samples coordinates"]
    compression: Compression
    clock: Float[np.ndarray, " coordinates+1"]

    @classmethod
    def from_drive(
        cls, drive: Drive, time: Float[np.ndarray, " samples"], steady_state: bool, tau: float
    ) -> "SharedBasis":
        """Return a basis for time constants within a factor 9 of `tau` (s). Double precision is required."""
        table = TableNodes.from_terms(HighpassTerms((1.0,), (tau,)), time, narrow=False)
        padded = _evaluate_functions(table, drive, pad_samples(time), steady_state)
        u, baseline, slope = (values[..., : time.size].T for values in padded)
        # fewer functions span the responses to this drive than those to any
        modes, sizes, nodes = np.linalg.svd(u, full_matrices=False)
        rank = round_up_column_count(np.count_nonzero(sizes > RANK_TOLERANCE * sizes[0]), sizes.size)
        series = sizes[:rank, None] * nodes[:rank] @ chebyshev(table.nodes.size)[1].T
        shapes = [*baseline.T, slope, (time - table.middle) * slope]
        functions, rows = np.linalg.qr(np.column_stack([modes[:, :rank], *shapes]))
        rows = np.pad(rows, ((0, 1), (0, 0)))  # the last coordinate is that of the rest of a record
        found = split_functions(rows, {"signal": rank} | dict.fromkeys((*BASELINE_NAMES, "slope", "clock"), 1))
        found |= dict.fromkeys(("decay", "effects", "steps"), rows[:, :0])
        found |= dict.fromkeys(("rate", "observed"), np.zeros((len(rows), 1)))
        compression = assemble_compression(dataclasses.replace(table, series=series), found, time.size)
        return cls(functions, compression, found["clock"][:, 0])

    def project(self, observed: Float[np.ndarray, "records samples"]) -> Float[np.ndarray, "records coordinates+1"]:
        """Return coordinates of records; the last is the length of the component outside the basis."""
        inside = observed @ self.functions
        square = np.vecdot(observed, observed) - np.vecdot(inside, inside)
        return np.column_stack([inside, np.sqrt(np.maximum(square, 0.0))])


_evaluate_functions = jit(evaluate_functions)
