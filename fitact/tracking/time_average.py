"""Statement of a record on its finger's time average and on the variation about it, without the prior and the walk.

Every window gives its own values, as if nothing joined the windows, so neither a rate nor its prior enters. The mean of
these values estimates the time average. Their covariance about it, less the mean covariance of their errors, estimates
the variation, without bias and with any time scale.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitact.model.circuit import FINGER_PARAMETERS
from fitact.tracking.random_walk import WindowInformation


class TimeAverage(NamedTuple):
    """Time averages of log Rsc, log Csc and log Ci over a record's windows, and the covariance about these.

    Where the windows do not determine the contact area, it is taken as constant: the last row of `factor` is nearly 0,
    and `within` has no variation of Ci.
    """

    factor: Float[np.ndarray, "3 3"]  # upper triangular: factor @ averages ~ N(target, 1)
    target: Float[np.ndarray, " 3"]
    within: Float[np.ndarray, "3 3"]  # covariance of the windows' values about their average, without their errors
    noise: Float[np.ndarray, "3 3"]  # mean covariance of the errors of a window
    windows: int  # windows with data
    duration: float  # from the first of these to the last, s
    sees_area: bool  # whether each window determines the contact area better than the prior

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "TimeAverage":
        """Make it from what `to_dict` returned."""
        factor, target, within, noise = (np.array(content[name]) for name in ("factor", "target", "within", "noise"))
        return cls(
            factor,
            target,
            within,
            noise,
            int(content["windows"]),
            float(content["duration_s"]),
            bool(content["sees_area"]),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `time_average` of a track's summary.json."""
        arrays = {name: getattr(self, name).tolist() for name in ("factor", "target", "within", "noise")}
        others = {"windows": self.windows, "duration_s": self.duration, "sees_area": self.sees_area}
        return {"names": list(FINGER_PARAMETERS), **arrays, **others}


def average_windows(
    information: WindowInformation,
    used: Bool[np.ndarray, " windows"],
    names: Sequence[str],
    prior: tuple[Float[np.ndarray, " parameters"], Float[np.ndarray, "parameters parameters"]],
    errors: Sequence[str],
    typical: Float[np.ndarray, " parameters"],
    span: float,
) -> TimeAverage | None:
    """Average windows over time; return None if Rsc, Csc and Ci are not all free, or fewer than three have data.

    Args:
        information: of the windows on all parameters.
        used: windows with data.
        names: parameters.
        prior: mean and covariance of these; only constants that are not `errors` receive it.
        errors: errors of the instruments, which are the same for all fingers and keep the mean of their prior.
        typical: smoothed mean values, for constants in the variation.
        span: time from the first of these windows to the last, s.
    """
    count = int(np.count_nonzero(used))
    if not set(FINGER_PARAMETERS) <= set(names) or count < 3:
        return None
    mean, covariance = prior
    finger = [names.index(name) for name in FINGER_PARAMETERS]
    fixed = [names.index(name) for name in errors]
    constants = [i for i in range(len(names)) if i not in (*finger, *fixed)]
    factor, target = (
        information.factor[used],
        information.target[used] - information.factor[used][:, :, fixed] @ mean[fixed],
    )

    def reduce(order: list[int]) -> np.ndarray:
        rows = np.concatenate([factor[:, :, order], target[:, :, None]], axis=2)
        return np.asarray(np.linalg.qr(rows, mode="r"))

    R = reduce([*finger, *constants])
    sees_area = bool(np.median(R[:, 2, 2] ** 2) * covariance[finger[2], finger[2]] > 1.0)
    n = 3 if sees_area else 2
    rest = [*finger[n:], *constants]
    m = n + len(rest)
    root = np.linalg.inv(R[:, :n, :n])
    values, slopes = (root @ R[:, :n, m:])[:, :, 0], root @ R[:, :n, n:m]  # values = values - slopes @ (the rest)
    errors_of_windows = root @ np.swapaxes(root, 1, 2)
    whitener = np.linalg.inv(np.linalg.cholesky(errors_of_windows.mean(axis=0) / count))
    about_average = whitener @ np.column_stack([np.eye(n), slopes.mean(axis=0), values.mean(axis=0)])
    about_rest = np.pad(R[:, n:m, n:].reshape(-1, m - n + 1), ((0, 0), (n, 0)))
    rows = np.concatenate([about_average, about_rest])
    if constants:
        precision_root = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(constants, constants)]))
        prior_rows = np.column_stack([np.zeros((len(constants), 3)), precision_root, precision_root @ mean[constants]])
        rows = np.concatenate([rows, prior_rows])
    order = [*range(3, m), 0, 1, 2, m]
    joint = np.asarray(np.linalg.qr(rows[:, order], mode="r"))[m - 3 : m, m - 3 :]
    deviations = values - slopes @ typical[rest]
    within, noise = np.zeros((3, 3)), np.zeros((3, 3))
    noise[:n, :n] = errors_of_windows.mean(axis=0)
    within[:n, :n] = np.cov(deviations.T, ddof=0) - (1.0 - 1.0 / count) * noise[:n, :n]
    return TimeAverage(joint[:, :3], joint[:, 3], within, noise, count, span, sees_area)
