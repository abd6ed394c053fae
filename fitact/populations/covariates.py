"""Covariates: further numbers about the fingers of the records, such as skin moisture."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float

from fitact.errors import InputError

_KEY = "record"  # column with the file names of the records


class Covariates(NamedTuple):
    """Covariates of the fingers."""

    names: tuple[str, ...]
    mean: Float[np.ndarray, " covariates"]  # over the fingers
    sd: Float[np.ndarray, " covariates"]
    z_scores: Float[np.ndarray, "fingers covariates"]  # covariates minus their mean, over their standard deviation

    @classmethod
    def from_values(cls, values: Mapping[str, Sequence[float]], fingers: int) -> Self:
        """Standardize covariates, with one number per finger under each name.

        Raises:
            InputError: the number of values is wrong, or they are not finite, all equal, or linearly dependent.
        """
        for name, column in values.items():
            if len(column) != fingers:
                raise InputError(f"covariate {name}: {len(column)} values for {fingers} records; give one for each")
            if not np.all(np.isfinite(column)):
                raise InputError(f"covariate {name}: a value is not finite; measure it, or leave that finger out")
            if np.ptp(column) == 0.0:
                raise InputError(
                    f"covariate {name}: all fingers have the same value, so its effect cannot be estimated; drop it"
                )
        table = np.array([values[name] for name in values], dtype=float).reshape(len(values), fingers).T
        mean, sd = table.mean(axis=0), table.std(axis=0)
        z_scores = (table - mean) / sd
        if np.linalg.matrix_rank(np.column_stack([np.ones(fingers), z_scores])) <= len(values):
            raise InputError(
                f"covariates {', '.join(values)}: they are linearly dependent over these {fingers} fingers; drop one,"
                " or measure more fingers"
            )
        return cls(tuple(values), mean, sd, z_scores)

    def standardize(self, raw_values: Mapping[str, float]) -> Float[np.ndarray, " covariates"]:
        """Express values in standard deviations from the mean; a missing one is 0.

        Raises:
            InputError: a name is not a covariate of the records.
        """
        unknown = [name for name in raw_values if name not in self.names]
        if unknown:
            known = ", ".join(self.names) or "none"
            raise InputError(f"covariate {unknown[0]}: is not among those of the records ({known}); check its name")
        values = np.array([raw_values.get(name, mean) for name, mean in zip(self.names, self.mean, strict=True)])
        return (values - self.mean) / self.sd


def read_covariates(path: Path, records: Sequence[Path]) -> dict[str, list[float]]:
    """Read covariates from a CSV with a column `record` (file names), in the order of `records`.

    Raises:
        InputError: the file cannot be read, or a record or a number is missing.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a CSV with a column 'record'") from error
    names = [name for name in (rows[0] if rows else {}) if name and name != _KEY]
    if not rows or _KEY not in rows[0] or not names:
        raise InputError(f"{path}: needs a column 'record' with file names, and a column for each covariate")
    rows_by_record: dict[str, dict[str, str]] = {}
    for line, row in enumerate(rows, 2):
        key = Path(str(row[_KEY]).strip()).name
        if key in rows_by_record:
            raise InputError(f"{path}, line {line}: {key} has a row already; keep one")
        rows_by_record[key] = row
    values: dict[str, list[float]] = {name: [] for name in names}
    for record in records:
        if record.name not in rows_by_record:
            raise InputError(f"{path}: has no row for {record.name}; add one, or leave the record out")
        for name in names:
            text = rows_by_record[record.name][name]
            try:
                values[name].append(float(text))
            except (TypeError, ValueError):
                raise InputError(f"{path}: {name} of {record.name} is {text!r}, not a number; write one") from None
    return values
