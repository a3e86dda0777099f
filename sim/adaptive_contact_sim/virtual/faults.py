"""What can go wrong on a bus, switched on by name and moment.

A fault is written ``kind:id=3,p=0.1@5+2``: of servo 3 (all without ``id``), with a probability of
0.1 per answer (always without ``p``), from 5 s after the start for 2 s (at once and for good
without).

=========  ==================================================================
silent     no answer
late       the answer comes ``ms`` later (30 by default)
flip       a bit of the answer is flipped
stale      the last answer's data again
error      the error byte says ``bits``: overload, overheating, voltage
hangup     the port is closed, as by a pulled cable, and back at the end
=========  ==================================================================
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Final, Literal, get_args

import msgspec
import numpy as np

from adaptive_contact.bridge.packets import ERROR_BITS
from adaptive_contact.bridge.tables import MODELS, ServoModel
from adaptive_contact.durations import seconds_of
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.scenario import split_spec

FaultKind = Literal["silent", "late", "flip", "stale", "error", "hangup"]
_EXAMPLE: Final = "silent:id=3@5+2"


class FaultSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A fault."""

    kind: FaultKind  # what happens
    servo: int | None = msgspec.field(name="id", default=None)  # to which, None for all
    probability: Annotated[float, msgspec.Meta(ge=0, le=1)] = msgspec.field(name="p", default=1.0)
    # start_s, end_s: since the start of the bus
    start_s: float = 0.0
    end_s: float = float("inf")
    ms: float = 30.0  # of a late answer
    bits: tuple[str, ...] = ("overload",)  # names of error bits
    port: str | None = None  # of a hang-up, None for all

    def error(self, model: ServoModel) -> int:
        """Its bits in a model's Hardware Error Status, or in protocol 1.0's error byte."""
        names = model.error_bits or ERROR_BITS
        return sum(bit for bit, name in names.items() if name in self.bits)


def parse_fault(text: str) -> FaultSpec:
    """Read a fault as a person writes it.

    Raises:
        ConfigurationError: it cannot be read.
    """
    where = f"fault '{text}'"
    fields, when = split_spec(text, where, _EXAMPLE)
    start, _, length = (when or "0").partition("+")
    # Where it says nothing a port hangs up for 1 s; other faults stay.
    usual = "1" if fields["kind"] == "hangup" else "1e9"
    begins_s, lasts_s = seconds_of(start), seconds_of(length or usual)
    if "bits" in fields:
        fields["bits"] = fields["bits"].split("|")
    known = {*ERROR_BITS.values(), *(bit for model in MODELS for bit in model.error_bits.values())}
    try:
        if begins_s is None or lasts_s is None or not known.issuperset(fields.get("bits", ())):
            raise msgspec.ValidationError("times are in seconds, bits those of error bytes")
        times = {"start_s": begins_s, "end_s": begins_s + lasts_s}
        return msgspec.convert(fields | times, FaultSpec, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigurationError(
            f"{where}: {error}; expected one of {', '.join(get_args(FaultKind))}, with id, p, ms, "
            f"bits or port, such as {_EXAMPLE}"
        ) from error


class FaultSchedule:
    """Which faults are on, and whether they strike now."""

    def __init__(self, specs: Iterable[FaultSpec], rng: np.random.Generator) -> None:
        self.specs = tuple(specs)  # may be replaced, from another thread
        self._rng = rng
        self.struck: dict[str, int] = {}

    def strike(self, kind: FaultKind, servo: int, elapsed_s: float) -> FaultSpec | None:
        """The fault of a kind that hits this answer, or None."""
        for spec in self.specs:
            if (
                spec.kind == kind
                and spec.servo in (None, servo)
                and spec.start_s <= elapsed_s < spec.end_s
                and (spec.probability >= 1.0 or self._rng.random() < spec.probability)
            ):
                self.struck[kind] = self.struck.get(kind, 0) + 1
                return spec
        return None

    def hung_up(self, port: str, elapsed_s: float) -> bool:
        """Whether a port's cable is out."""
        return any(
            spec.kind == "hangup"
            and spec.port in (None, port)
            and spec.start_s <= elapsed_s < spec.end_s
            for spec in self.specs
        )

    def flip(self, packet: bytes) -> bytes:
        """A packet with one bit turned."""
        at = int(self._rng.integers(len(packet)))
        turned = packet[at] ^ (1 << int(self._rng.integers(8)))
        return packet[:at] + bytes((turned,)) + packet[at + 1 :]
