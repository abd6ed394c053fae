"""Exception for invalid input."""


class InputError(ValueError):
    """Invalid input; the message is one sentence that names the file, the line or field, and a remedy.

    The command line prints this sentence to standard error and exits with status 2.
    """
