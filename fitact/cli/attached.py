"""`python -m fitact.cli.attached ARGUMENTS`: a command that Ctrl-C interrupts when its standard input ends.

Thus the process that holds the other end of the pipe interrupts the command, on every system, and so does its death.
"""

import os
import signal
import threading

from fitact.cli import main


def _interrupt_at_end() -> None:
    while os.read(0, 1):
        pass
    if os.name == "posix":
        os.kill(os.getpid(), signal.SIGINT)  # to the process, so that a blocked main thread wakes up
    else:
        signal.raise_signal(signal.SIGINT)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the parent process ignores it
    threading.Thread(target=_interrupt_at_end, daemon=True).start()
    main()
