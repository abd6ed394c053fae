"""Sections [instrument] and [[calibration]] of a scene file: the equipment of each channel, and records of dummies.

Certificates replace what the class of a piece of equipment says. A dummy is a circuit of known parts.
"""

import dataclasses
import difflib
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from fitact.instrument.classes import CLASSES
from fitact.instrument.pieces import Piece
from fitact.prior.distributions import Distribution, LogNormal, Uniform
from fitact.prior.published import Layer
from fitact.scene.prior_spec import FaradPriorSpec, OhmPriorSpec, PriorSpec
from fitact.scene.section import Section, Unit

_CHANNELS = ("V", "Vsc", "I", "Z", "Ft")
Ratio = Annotated[float, Unit(""), Field(gt=0, lt=1)]


class ErrorSpec(Section):
    """Relative error: limits (uniform), or an expanded uncertainty with its coverage factor (normal)."""

    tolerance: Ratio | None = None
    expanded: Ratio | None = None
    k: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check_form(self) -> Self:
        if self.model_fields_set not in ({"tolerance"}, {"expanded", "k"}):
            raise ValueError("write {tolerance} for limits, or {expanded, k} for a certificate")
        return self

    def distribution(self) -> Distribution:
        """Return the distribution of the factor between indicated and true values."""
        if self.expanded is not None and self.k is not None:
            return LogNormal(1.0, self.expanded / self.k)
        return Uniform.with_tolerance(1.0, self.tolerance or 0.0)


class CertificateSpec(Section):
    """Errors of one piece, which replace those of its class; `gain_common` is shared by the channels of an instrument.

    `skew` is the largest delay (s) between its channels, `resistance` and `capacitance` are those of its input.
    """

    gain: ErrorSpec | None = None
    gain_common: ErrorSpec | None = None
    compensation: ErrorSpec | None = None
    nonlinearity: ErrorSpec | None = None
    skew: Annotated[float, Unit("s"), Field(ge=0)] | None = None
    resistance: OhmPriorSpec | None = None
    capacitance: FaradPriorSpec | None = None


class InstrumentSection(Section):
    """Pieces of equipment that each channel passes through, as "class:piece"."""

    V: tuple[str, ...] = ()
    Vsc: tuple[str, ...] = ()
    I: tuple[str, ...] = ()  # noqa: E741  (the name of the channel)
    Z: tuple[str, ...] = ()
    Ft: tuple[str, ...] = ()
    own: dict[str, CertificateSpec] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_pieces(self) -> Self:
        classes: dict[str, str] = {}
        for channel in _CHANNELS:
            for name in getattr(self, channel):
                kind, colon, piece = name.partition(":")
                if not colon or not piece:
                    raise ValueError(
                        f"[instrument] {channel}: '{name}' is not 'class:piece', such as 'probe-10x:P1'; name the piece"
                    )
                if kind not in CLASSES:
                    near = difflib.get_close_matches(kind, CLASSES, n=1)
                    hint = f"did you mean '{near[0]}'? " if near else ""
                    raise ValueError(
                        f"[instrument] {channel}: '{kind}' is not a class; {hint}known: {', '.join(CLASSES)}"
                    )
                if classes.setdefault(piece, kind) != kind:
                    raise ValueError(
                        f"[instrument] piece '{piece}' is named with two classes, {classes[piece]} and {kind}; name it"
                        " with one"
                    )
        known = {f"{kind}:{part}" for piece, kind in classes.items() for part in (piece, piece.partition("/")[0])}
        for name, certificate in self.own.items():
            if name not in known:
                raise ValueError(
                    f"[instrument.own] '{name}' is no piece of a channel; known: {', '.join(sorted(known)) or 'none'}"
                )
            for key in ("resistance", "capacitance"):
                spec = getattr(certificate, key)
                if spec is not None and (not spec.is_free or spec.table is not None):
                    raise ValueError(
                        f"[instrument.own] '{name}' {key}: write {{nominal, tolerance}} or {{median, relative_sd}}"
                    )
        return self

    @property
    def is_stated(self) -> bool:
        """Whether any channel has a piece."""
        return any(getattr(self, channel) for channel in _CHANNELS)

    def describe_channels(self, name: str) -> str:
        """Return the channels that a piece, or an instrument with such channels, belongs to, as "V and Vsc"."""
        channels = [c for c in _CHANNELS if any(n in (name, f"{name}/{n.partition('/')[2]}") for n in getattr(self, c))]
        return " and ".join(channels)

    def pieces(self, channel: str) -> tuple[Piece, ...]:
        """Return the pieces of a channel, and what its instruments share, in the order of the file."""
        found: dict[str, Piece] = {}
        for name in getattr(self, channel):
            instrument = name.partition("/")[0]
            if instrument != name and (shared := self.own.get(instrument)) is not None and shared.gain_common:
                gain = shared.gain_common.distribution()
                found[instrument] = Piece(instrument, gain)
            found[name] = self._apply_certificate(Piece.from_class(name))
        return tuple(found.values())

    def _apply_certificate(self, piece: Piece) -> Piece:
        own = self.own.get(piece.name)
        if own is None:
            return piece
        stated: dict[str, Any] = {}
        if own.skew is not None:
            stated = {"skew": own.skew, "skew_intervals": 0.0}
        for key, spec in own:
            if isinstance(spec, ErrorSpec) and key != "gain_common":
                stated[key] = spec.distribution()
            elif isinstance(spec, PriorSpec):
                stated[key] = spec.distribution(key, None, Layer(1.0, 1.0, 1.0))  # no table, so no layer
        return dataclasses.replace(piece, source="certificate", **stated)


class DummyCircuit(Section):
    """Known parts of a dummy: two parallel circuits Rsc‖Csc in series with Ci."""

    Rsc: OhmPriorSpec
    Csc: FaradPriorSpec
    Ci: FaradPriorSpec

    @model_validator(mode="before")
    @classmethod
    def _require_parts(cls, content: Any) -> Any:
        missing = [name for name in cls.model_fields if not isinstance(content, dict) or name not in content]
        if missing:
            raise ValueError(
                f"[[calibration]] circuit lacks {' and '.join(missing)}; write a value with its tolerance, such as"
                ' {nominal = "160 kohm", tolerance = "0.1 %"}'
            )
        return content


class CalibrationSection(Section):
    """A record of a dummy circuit, or "open", without any finger, made with the instruments of the scene."""

    record: str
    circuit: DummyCircuit | Literal["open"]

    @model_validator(mode="before")
    @classmethod
    def _require_both(cls, content: Any) -> Any:
        if isinstance(content, dict) and not {"record", "circuit"} <= set(content):
            raise ValueError(
                '[[calibration]] needs a record and its circuit: record = "dummy.csv" and circuit = {Rsc = {nominal ='
                ' "160 kohm", tolerance = "0.1 %"}, Csc = ..., Ci = ...}'
            )
        return content
