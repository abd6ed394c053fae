"""Optional libraries, imported where they are used."""

import importlib
import types

from fitact.errors import InputError


def import_extra(module: str, extra: str, source: str) -> types.ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{source}: needs {module.partition('.')[0]}, which is not installed; pip install 'fitact[{extra}]', or"
            " export the record as CSV"
        ) from error
