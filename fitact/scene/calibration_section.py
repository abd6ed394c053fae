"""Tables [[calibration]] of a scene file: records of dummy circuits of known parts."""

from typing import Any

from pydantic import model_validator

from fitact.scene.prior_spec import FaradPriorSpec, OhmPriorSpec
from fitact.scene.section import Section


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
    """A record of a dummy circuit, made with the instruments of the scene."""

    record: str
    circuit: DummyCircuit

    @model_validator(mode="before")
    @classmethod
    def _require_both(cls, content: Any) -> Any:
        if isinstance(content, dict) and not {"record", "circuit"} <= set(content):
            raise ValueError(
                '[[calibration]] needs a record and its circuit: record = "dummy.csv" and circuit = {Rsc = {nominal ='
                ' "160 kohm", tolerance = "0.1 %"}, Csc = ..., Ci = ...}'
            )
        return content
