"""Constructor signatures of equinox modules, which mkdocstrings does not recognise as dataclasses."""

import inspect
from typing import Any

import equinox as eqx
import griffe

import fitact


class Constructors(griffe.Extension):
    """Extension that gives each public module its Python signature, with the annotations of its source."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        for name in fitact.__all__ if pkg.name == "fitact" else ():
            public = getattr(fitact, name)
            if isinstance(public, type) and issubclass(public, eqx.Module):
                described = pkg[name].final_target
                described.set_member("__init__", _constructor(public, described))


def _constructor(public: type, described: griffe.Class) -> griffe.Function:
    known = described.all_members
    parameters = [griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)]
    for name, each in inspect.signature(public).parameters.items():
        kind = griffe.ParameterKind[each.kind.name.lower()]
        default = None if each.default is each.empty else repr(each.default)
        parameters.append(griffe.Parameter(name, annotation=known[name].annotation, kind=kind, default=default))
    return griffe.Function("__init__", parameters=griffe.Parameters(*parameters), parent=described)
