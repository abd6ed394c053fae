"""The exception that fitact raises when it refuses input."""


class InputError(ValueError):
    """Input that cannot be used: one sentence naming the file, the line or field, and the remedy.

    On the command line it becomes that sentence on standard error and exit code 2.
    """
