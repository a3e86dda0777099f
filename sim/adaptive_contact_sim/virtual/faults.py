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

import dataclasses
import re
from collections.abc import Callable, Iterable
from typing import Any, Final, Literal, cast, get_args

import numpy as np

from adaptive_contact.bridge.packets import ERROR_BITS
from adaptive_contact.bridge.tables import MODELS, ServoModel
from adaptive_contact.errors import ConfigurationError

FaultKind = Literal["silent", "late", "flip", "stale", "error", "hangup"]
_KINDS: Final = get_args(FaultKind)
_FORM: Final = re.compile(
    r"(?P<kind>[a-z]+)(?::(?P<settings>[^@]*))?"
    r"(?:@(?P<start>\d+\.?\d*)(?:\+(?P<length>\d+\.?\d*))?)?\Z"
)
_EXAMPLE: Final = "silent:id=3@5+2"


@dataclasses.dataclass(frozen=True)
class FaultSpec:
    """A fault."""

    kind: FaultKind  # what happens
    servo: int | None = None  # to which, None for all
    probability: float = 1.0  # per answer
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
    match = _FORM.match(text)
    if match is None or match["kind"] not in _KINDS:
        raise ConfigurationError(
            f"fault '{text}': expected one of {', '.join(_KINDS)}, with times in seconds, such as "
            f"{_EXAMPLE}"
        )
    start = float(match["start"] or 0.0)
    spec = FaultSpec(
        kind=cast(FaultKind, match["kind"]),
        start_s=start,
        end_s=start + float(match["length"]) if match["length"] else float("inf"),
    )
    settings: dict[str, tuple[str, Callable[[str], Any]]] = {
        "id": ("servo", int),
        "p": ("probability", float),
        "ms": ("ms", float),
        "port": ("port", str),
        "bits": ("bits", lambda names: tuple(names.split("|"))),
    }
    known = {*ERROR_BITS.values(), *(bit for model in MODELS for bit in model.error_bits.values())}
    for part in filter(None, (match["settings"] or "").split(",")):
        name, _, value = part.partition("=")
        try:
            field, convert = settings[name.strip()]
            spec = dataclasses.replace(spec, **{field: convert(value.strip())})
            if not 0.0 <= spec.probability <= 1.0 or not known.issuperset(spec.bits):
                raise ValueError(value)
        except (KeyError, ValueError):
            raise ConfigurationError(
                f"fault '{text}': '{part}' cannot be read; settings are id, p, ms, bits, port, "
                f"such as {_EXAMPLE}"
            ) from None
    if spec.kind == "hangup" and spec.end_s == float("inf"):
        spec = dataclasses.replace(spec, end_s=spec.start_s + 1.0)
    return spec


class FaultSchedule:
    """Which faults are on, and whether they strike now."""

    def __init__(self, specs: Iterable[FaultSpec], rng: np.random.Generator) -> None:
        self._specs = tuple(specs)
        self._rng = rng
        self.struck: dict[str, int] = {}

    def switch(self, specs: Iterable[FaultSpec]) -> None:
        """Put other faults in force; may be called from another thread."""
        self._specs = tuple(specs)

    def strike(self, kind: FaultKind, servo: int, elapsed_s: float) -> FaultSpec | None:
        """The fault of a kind that hits this answer, or None."""
        for spec in self._specs:
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
            for spec in self._specs
        )

    def flip(self, packet: bytes) -> bytes:
        """A packet with one bit turned."""
        at = int(self._rng.integers(len(packet)))
        turned = packet[at] ^ (1 << int(self._rng.integers(8)))
        return packet[:at] + bytes((turned,)) + packet[at + 1 :]
