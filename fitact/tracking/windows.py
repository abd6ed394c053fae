"""Windows of a long record, from blocks of samples that arrive one after another."""

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitact.errors import InputError
from fitact.readers.stream import Block


class Window(NamedTuple):
    """Consecutive samples of all channels."""

    start: float  # time of the first sample, s
    channels: Mapping[str, Float[np.ndarray, " samples"]]

    @property
    def is_whole(self) -> bool:
        """Whether all samples are numbers."""
        return all(bool(np.isfinite(values).all()) for values in self.channels.values())


def split_windows(
    blocks: Iterable[Block], step: float, samples: int, source: str, max_change: float = 0.01
) -> Iterator[Window]:
    """Yield windows of `samples` samples, `step` s apart; after lost samples, a new window begins.

    Raises:
        InputError: times that do not increase, or steps that differ from `step` by more than `max_change`.
    """
    time, channels = np.empty(0), dict[str, np.ndarray]()
    for block in itertools.chain(blocks, [None]):
        if block is not None:
            time = np.concatenate([time, block.time])
            channels = {n: np.concatenate([channels.get(n, np.empty(0)), v]) for n, v in block.channels.items()}
        steps = np.diff(time)
        _check_steps(time, steps, step, source, max_change)
        begin = 0
        for end in [*(np.flatnonzero(steps > 1.5 * step) + 1).tolist(), time.size]:
            for first in range(begin, end - samples + 1, samples):
                begin = first + samples
                yield Window(float(time[first]), {name: each[first:begin] for name, each in channels.items()})
            begin = begin if end == time.size else end
        time, channels = time[begin:], {name: each[begin:] for name, each in channels.items()}


def _check_steps(time: np.ndarray, steps: np.ndarray, step: float, source: str, max_change: float) -> None:
    if not np.all(steps > 0.0):
        row = int(np.argmin(steps > 0.0))
        raise InputError(
            f"{source}: the time does not increase after {time[row]:.9g} s; a track needs samples in order, so export"
            " the record again"
        )
    run = 100  # steps of which more than half differ where the rate has changed
    usual = np.median(steps[: steps.size // run * run].reshape(-1, run), axis=1)
    changed = np.abs(usual / step - 1.0) > max_change
    if changed.any():
        place = int(np.argmax(changed))
        raise InputError(
            f"{source}: the time step changes from {step:.4g} s to {usual[place]:.4g} s near {time[run * place]:.4g} s;"
            " track each part with one rate by itself"
        )
