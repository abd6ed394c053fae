"""Exception for invalid input, and the options that refusals name as remedies."""

import shlex
from collections.abc import Mapping

RATE_OPTION = "--rate 100kHz (in Python: rate=100e3)"
SEGMENT_OPTION = "--segment 1 (in Python: segment=1)"


class InputError(ValueError):
    """Invalid input; the message is one sentence that names the file, the line or field, and a remedy.

    The command line prints this sentence to standard error and exits with status 2.
    """


def channel_option(columns: Mapping[str, str]) -> str:
    """Return the option that names the columns of channels, and the argument in Python."""
    options = " ".join(f"--channel {shlex.quote(f'{channel}={column}')}" for channel, column in columns.items())
    return f"{options} (in Python: channels={dict(columns)})"


def scale_option(channel: str, factor: float = 10) -> str:
    """Return the option that multiplies a channel, and the argument in Python."""
    return f"--scale {channel}={factor:g} (in Python: scale={{'{channel}': {factor:g}}})"
