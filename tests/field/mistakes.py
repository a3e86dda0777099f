"""Mistakes of real sources, made in recordings of legs that are right.

Each takes the messages of a recording and returns those that a source with one mistake sends.
Randomness is passed in.  Touches (``truth``) stay as they are.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np

from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.wire import MSGPACK

PERIOD_NS: Final = 20_000_000
AX12_STEP: Final = math.radians(300.0) / 1023


@dataclasses.dataclass(frozen=True)
class Sent:
    """One message: its key, when it was sent, and its fields."""

    key: str
    at_ns: int
    body: dict[str, Any]

    @property
    def leg(self) -> str:
        return self.key.split("/")[2]

    @property
    def is_sample(self) -> bool:
        return self.key.endswith("/servo")

    def but(self, **fields: Any) -> Sent:
        return dataclasses.replace(self, body={**self.body, **fields})


Messages = Sequence[Sent]
Mistake = Callable[[Messages, np.random.Generator], Iterator[Sent]]
Angles = list[float]


def read(path: Path) -> list[Sent]:
    """The messages of a recording, in its order."""
    return [
        Sent(record.key, record.log_time_ns, msgpack.unpackb(record.payload))
        for record in read_recording(path)
    ]


def first(messages: Messages, seconds: float) -> list[Sent]:
    """The first seconds."""
    return [sent for sent in messages if sent.at_ns <= messages[0].at_ns + seconds * 1e9]


def last(messages: Messages, seconds: float) -> list[Sent]:
    """The last seconds."""
    return [sent for sent in messages if sent.at_ns >= messages[-1].at_ns - seconds * 1e9]


def write(path: Path, messages: Messages, about: dict[str, str] | None = None) -> Path:
    """A recording of messages; ``about`` is what the writer says of it."""
    with RecordingWriter(path, about or {}) as file:
        for sent in messages:
            file.write(sent.key, msgpack.packb(sent.body), MSGPACK, sent.at_ns)
    return path


def each_sample(change: Callable[[Sent, np.random.Generator], Sent]) -> Mistake:
    """A mistake that is made in every sample by itself."""

    def made(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
        for sent in messages:
            yield change(sent, rng) if sent.is_sample else sent

    return made


def remembering(
    change: Callable[[Sent, np.random.Generator, dict[str, Any]], Sent],
) -> Mistake:
    """A mistake that is made in every sample, by what is kept of earlier ones."""

    def made(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
        kept: dict[str, Any] = {}
        yield from each_sample(lambda sent, rng: change(sent, rng, kept))(messages, rng)

    return made


def angles(change: Callable[[Angles], Angles], *names: str) -> Mistake:
    """The same change to the readings and to the commands, or to the fields named."""
    fields = names or ("measured", "desired")

    def changed(sent: Sent, _: np.random.Generator) -> Sent:
        return sent.but(**{name: change(sent.body[name]) for name in fields})

    return each_sample(changed)


# -- times -----------------------------------------------------------------------------------------


def stamped(late_periods: Callable[[np.random.Generator, int], float]) -> Mistake:
    """Stamps off by so many periods, all legs' of a tick alike; readings and numbers are right."""

    def changed(sent: Sent, _: np.random.Generator, newest: dict[str, int]) -> Sent:
        tick = sent.body["seq"]
        late = late_periods(np.random.default_rng([1, tick]), tick)
        t_ns = sent.body["t_ns"] + round(late * PERIOD_NS)
        newest[sent.key] = t_ns = max(newest.get(sent.key, 0) + 1, t_ns)
        return sent.but(t_ns=t_ns)

    return remembering(changed)


# A loop that takes turns: three short cycles and a long one.
_TURNS: Final = (0.0, -0.45, 0.25, 0.5, -0.3)


def jitter(periods: float) -> Mistake:
    """Stamps off by so many periods, one standard deviation."""
    return stamped(lambda rng, _: rng.normal(0.0, periods))


white_jitter = jitter(0.25)
turns_jitter = stamped(lambda _, tick: _TURNS[tick % len(_TURNS)])
float_seconds = each_sample(lambda sent, _: sent.but(t_ns=sent.body["t_ns"] / 1e9))
milliseconds = each_sample(lambda sent, _: sent.but(t_ns=sent.body["t_ns"] // 1_000_000))


def bursts(ticks: int) -> Mistake:
    """So many ticks arrive together, and are stamped on arrival."""
    return stamped(lambda _, tick: ticks - 1 - 0.985 * (tick % ticks))


def slower(factor: float) -> Mistake:
    """A control loop of another period than the description's."""
    return each_sample(lambda sent, _: sent.but(t_ns=round(sent.body["t_ns"] * factor)))


def lossy(share: float) -> Mistake:
    """Samples that never arrive."""

    def made(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
        for sent in messages:
            if not (sent.is_sample and rng.random() < share):
                yield sent

    return made


def restarting(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """A source that gives every sample a `run` of its own."""
    for number, sent in enumerate(messages):
        yield sent.but(run=number) if sent.is_sample else sent


def doubled(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """A second publisher of every leg, started later."""
    for sent in messages:
        yield sent
        if sent.is_sample:
            yield sent.but(run=7, measured=[0.0] * len(sent.body["measured"]))


# -- readings --------------------------------------------------------------------------------------


def raw_zeros(share: float = 0.005, value: float = math.radians(-150.0)) -> Mistake:
    """Failed reads of a share of readings, each by itself, that leave raw step 0 behind."""
    return each_sample(
        lambda sent, rng: sent.but(
            measured=[value if rng.random() < share else x for x in sent.body["measured"]]
        )
    )


def encoder_seam(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """The encoder wraps in the middle of the first joint's travel."""
    travel: dict[str, Angles] = {}
    for sent in messages:
        if sent.is_sample:
            travel.setdefault(sent.key, []).append(sent.body["measured"][0])
    middle = {key: float(np.median(values)) for key, values in travel.items()}
    for sent in messages:
        if not sent.is_sample:
            yield sent
            continue
        wrap = lambda x, at=middle[sent.key]: (x - at) % math.tau  # noqa: E731
        first = {
            name: [wrap(sent.body[name][0]), *sent.body[name][1:]]
            for name in ("measured", "desired")
        }
        yield sent.but(**first)


def _written(sent: Sent, ticks: int, goals: dict[str, Any]) -> Angles:
    """The goal of so many ticks ago."""
    written = goals.setdefault(sent.key, [])
    written.append(sent.body["desired"])
    return written[max(len(written) - 1 - ticks, 0)]


def echoed(delay: int = 0) -> Mistake:
    """The goal, as written so many ticks ago, is published as the reading."""
    return remembering(lambda sent, _, goals: sent.but(measured=_written(sent, delay, goals)))


def late_goals(ticks: int) -> Mistake:
    """Goals are published so many ticks after they were written."""
    return remembering(lambda sent, _, goals: sent.but(desired=_written(sent, ticks, goals)))


def noisy_goals(delay: int, rad: float = 1e-4) -> Mistake:
    """The goal of so many ticks ago is published as the reading, with noise."""

    def changed(sent: Sent, rng: np.random.Generator, goals: dict[str, Any]) -> Sent:
        row = _written(sent, delay, goals)
        return sent.but(measured=[x + float(rng.normal(0.0, rad)) for x in row])

    return remembering(changed)


def held(ticks: int, *, by_turns: bool = False) -> Mistake:
    """Each reading is published for so many ticks; all legs are read at once, or by turns."""

    def changed(sent: Sent, _: np.random.Generator, read: dict[str, Any]) -> Sent:
        read.setdefault(sent.leg, sent.body["measured"])
        turn = list(read).index(sent.leg) if by_turns else 0
        if sent.body["seq"] % ticks == turn % ticks:
            read[sent.leg] = sent.body["measured"]
        return sent.but(measured=read[sent.leg])

    return remembering(changed)


def rounded(step: float) -> Mistake:
    """Readings of a servo with coarser steps."""
    return angles(lambda row: [round(x / step) * step for x in row], "measured")


def _shared(sent: Sent, _: np.random.Generator, shared: dict[str, Any]) -> Sent:
    if not shared or sent.leg == shared["leg"]:
        shared |= {"leg": sent.leg, **{k: sent.body[k] for k in ("measured", "desired")}}
    return sent.but(measured=shared["measured"], desired=shared["desired"])


# A loop over legs whose publishers share one variable: all send one leg's angles.
one_for_all = remembering(_shared)


def caught(leg: str, from_s: float, most_rad: float) -> Mistake:
    """A cable holds a foot from some time on; beyond this the second joint stretches it.

    Without any give it would be a servo's own limit, which is found and is no fault.
    """

    def changed(sent: Sent, _: np.random.Generator) -> Sent:
        if sent.leg != leg or sent.at_ns < from_s * 1e9:
            return sent
        first, second, *rest = sent.body["measured"]
        held = round(0.85 * max(second - most_rad, 0.0) / AX12_STEP) * AX12_STEP
        return sent.but(measured=[first, second - held, *rest])

    return each_sample(changed)


def without_torque(joint: int, step_rad: float = AX12_STEP) -> Mistake:
    """A servo that answers but has no torque: only the last step of its encoder flickers."""

    def changed(sent: Sent, rng: np.random.Generator, first: dict[str, float]) -> Sent:
        row = list(sent.body["measured"])
        row[joint] = first.setdefault(sent.key, row[joint]) + step_rad * int(rng.integers(2))
        return sent.but(measured=row)

    return remembering(changed)


def frozen(joint: int) -> Mistake:
    """A servo that answers with its first reading for ever."""
    return without_torque(joint, 0.0)


degrees = angles(lambda row: [math.degrees(x) for x in row])
registers = angles(lambda row: [round(512 + x / AX12_STEP) for x in row])
pitch_down = angles(lambda row: [row[0], *(-x for x in row[1:])])
goals_mirrored = angles(lambda row: [row[0], -row[1], row[2]], "desired")
zero_moved = angles(lambda row: [row[0], row[1] + 0.8, row[2]], "measured")
swapped = angles(lambda row: [row[0], row[2], row[1]])
swapped_readings = angles(lambda row: [row[0], row[2], row[1]], "measured")
turned_readings = angles(lambda row: [row[1], row[2], row[0]], "measured")
one_turn_off = angles(lambda row: [row[0] + math.tau, *row[1:]], "measured")
never_stance = each_sample(lambda sent, _: sent.but(phase="swing"))


def numbered(seq: Callable[[int], int]) -> Mistake:
    """Numbers of ticks that are not counted up by one in 64 bits."""
    return each_sample(lambda sent, _: sent.but(seq=seq(sent.body["seq"])))


def with_fields(**fields: object) -> Mistake:
    """Fields of every sample set to one value."""
    return each_sample(lambda sent, _: sent.but(**fields))


def twice(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """Every message sent twice, as by two bridges between the same networks."""
    for sent in messages:
        yield sent
        yield sent


def out_of_order(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """One sample in twenty of a leg overtaken by its next one."""
    kept: dict[str, Sent] = {}
    for sent in messages:
        if sent.is_sample and sent.key not in kept and sent.body["seq"] % 20 == 0:
            kept[sent.key] = sent
            continue
        yield sent
        if sent.is_sample and sent.key in kept:
            yield kept.pop(sent.key)


def renamed(names: dict[str, str]) -> Mistake:
    """Legs published under other ids."""

    def made(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
        for sent in messages:
            leg = names.get(sent.leg, sent.leg)
            yield dataclasses.replace(sent, key=sent.key.replace(f"/{sent.leg}/", f"/{leg}/"))

    return made


def misspelt(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
    """A key that nobody reads."""
    for sent in messages:
        yield dataclasses.replace(sent, key=sent.key.replace("/servo", "/servos"))


def compose(*mistakes: Mistake) -> Mistake:
    """Several mistakes, one after the other."""

    def made(messages: Messages, rng: np.random.Generator) -> Iterator[Sent]:
        for mistake in mistakes:
            messages = list(mistake(messages, rng))
        yield from messages

    return made
