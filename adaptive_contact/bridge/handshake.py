"""Checks servos before a bridge starts: missing, wrong, or wrongly set.

One message reports everything that is wrong, and nothing because of one answer alone; what is
looked for, and what ``configure`` writes: docs/bridge.md, "The handshake".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import msgspec

from adaptive_contact.bridge.bus import MOST_PATIENT_MS, Bus, Pong
from adaptive_contact.bridge.drive import remedy, standing
from adaptive_contact.bridge.modes import followed, setting
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.bridge.port import latency_advice
from adaptive_contact.bridge.tables import MODELS, ServoModel, model_of_number, tool_of
from adaptive_contact.errors import BusError
from adaptive_contact.robot import Port
from adaptive_contact.robot.description import Protocol

ALL_IDS: Final = range(MAX_ID + 1)
# A baud rate, and a protocol.
Place = tuple[int, Protocol]

# Rates that servos are delivered with, and those set most; then others that they can have.
USUAL_BAUDS: Final = (1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
# Servos are numbered one after the other: so far beyond the last found, all are asked again.
BEYOND: Final = 8

BUSY: Final = (
    "this computer is too busy, or its adapter holds bytes back; end other programs, run with "
    "--realtime, and see 'Timing' in docs/bridge.md"
)

# A tenth of what servos are delivered with; 18 of these cost 2 ms a cycle at the most.
_MOST_DELAY_US: Final = 100
_PATIENT_MS: Final = 25.0


@dataclasses.dataclass
class Findings:
    """Holds what a handshake found."""

    # why the bridge cannot run, one line each
    errors: list[str] = dataclasses.field(default_factory=list)
    # what to set for it to run well, and what was set with ``configure``, one line each
    advice: list[str] = dataclasses.field(default_factory=list)

    def raise_errors(self) -> None:
        """Raise all errors as one message.

        Raises:
            BusError: there are errors.
        """
        if len(self.errors) == 1:
            raise BusError(self.errors[0])
        if self.errors:
            count = len(self.errors)
            raise BusError(f"{count} things stand in the way of the bridge:", self.errors)


def crowd(servos: int) -> int:
    """Return how many silent servos of a port must have a common cause."""
    return max(2, (servos + 1) // 2)


def check_ports(
    plans: Sequence[PortPlan], *, configure: bool = False, full: bool = True, drive: bool = False
) -> Findings:
    """Examine all ports, each on a thread of its own.

    Args:
        plans: what is expected where.
        configure: write what should be set differently, EEPROM included.
        full: look for unexpected servos too, which takes about a second.
        drive: they are to be driven, not only observed.
    """
    with ThreadPoolExecutor(max_workers=len(plans)) as pool:
        checks = [_Handshake(p, configure=configure, full=full, drive=drive) for p in plans]
        findings = Findings()
        for found in pool.map(_Handshake.run, checks):
            findings.errors += found.errors
            findings.advice += found.advice
    return findings


def find_all(
    bus: Bus,
    asked: Iterable[int],
    expected: Iterable[int] | None = None,
    configure: Collection[int] | None = (),
) -> tuple[dict[int, Pong], list[str]]:
    """Find who is on a bus; let servos that answer pings only answer reads, if wanted.

    Args:
        bus: the port; its time for answers is longer afterwards.
        asked: ids to ask.
        expected: who ought to be there, and is asked again; without, all up to some beyond the last
            that answers.
        configure: whose status return level may be set; None for all.

    Returns:
        Who answers, by id in order, and what was set, or why it was not, one line each.

    Raises:
        PortLostError: the port is gone.
    """
    found = {}
    for servo in asked:
        pong = bus.ping(servo)
        if pong is not None:
            found[servo] = pong
    bus.settle(100.0 if found else MOST_PATIENT_MS)  # were some late?
    if not found and not bus.late:  # a bus without an answer is asked once
        return {}, []
    if expected is None:
        expected = range(min(max({*found, *bus.late}) + BEYOND, MAX_ID) + 1)
    found = scan_again(bus, found, {*expected, *bus.late})
    lines = []
    for servo, pong in list(found.items()):
        if not pong.reads and (configure is None or servo in configure):
            lines.append(f"servo {servo}: {_let_answer(bus, found, servo)}")
    return found, lines


def scan_again(bus: Bus, found: dict[int, Pong], ids: Iterable[int]) -> dict[int, Pong]:
    """Ask those servos again, patiently, whose answer did not arrive, came late or was damaged.

    One lost or late packet is neither a missing servo nor a second one of the same id.

    Args:
        bus: the port; its time for answers is longer afterwards.
        found: what a scan has received.
        ids: who else may be there.

    Returns:
        Who answers, by id in order.

    Raises:
        PortLostError: the port is gone.
    """
    bus.port.timeout_ms = max(bus.port.timeout_ms, _PATIENT_MS)
    pongs = {}
    for servo in sorted({*ids, *found}):
        pong = found.get(servo)
        if pong is None or not pong.reads or pong.doubled:
            pong = _again(bus, servo, pong)
        if pong is None:
            continue
        number = bus.confirmed(servo, bus.model_number.block) if pong.reads else None
        if number is not None:  # what a scan took for it may have been another answer
            pong = pong._replace(model_number=bus.model_number.value(number))
        model = model_of_number(pong.model_number, bus.protocol)
        if model is not None and not pong.doubled and not bus.is_clear(servo, model.measured):
            pong = pong._replace(doubled=True)
        pongs[servo] = pong
    return pongs


def named(pong: Pong, protocol: Protocol) -> str:
    """Describe a servo in words."""
    model = model_of_number(pong.model_number, protocol)
    if model is not None:
        return model.name
    return (
        "answers pings only" if pong.model_number is None else f"model number {pong.model_number}"
    )


def doubled_text(servos: Iterable[int]) -> str:
    """Describe ids that several servos have."""
    return (
        f"several servos answer to id {', '.join(map(str, servos))} (or its line is disturbed); "
        "connect them one by one and give each an id of its own"
    )


def astray_text(port: Port, place: Place, ids: Sequence[int]) -> str:
    """Describe servos that answer at another rate, or in the other protocol, than their port's."""
    baud, protocol = place
    does = "answers" if len(ids) == 1 else "answer"
    what = "baud rate" if protocol == port.protocol else "baud rate and protocol"
    return (
        f"servo {', '.join(map(str, ids))} {does} at {baud} baud, protocol {protocol}, not at "
        f"{port.baud} baud, protocol {port.protocol}; set its {what} with "
        f"{tool_of(port.protocol)}, as all servos of a port have one"
    )


def find_elsewhere(
    name: str, port: Port, ids: Sequence[int], bauds: Sequence[int] = USUAL_BAUDS
) -> dict[Place, list[int]]:
    """Find servos that do not answer as the port is set; writes nothing.

    Args:
        name: of the port.
        port: as it is set; closed.
        ids: of the servos to find.
        bauds: rates to try, of Dynamixel in both protocols.

    Returns:
        Ids by the baud rate and the protocol at which they answer.
    """
    found: dict[Place, list[int]] = {}
    left = list(ids)
    others: dict[Protocol, tuple[Protocol, ...]] = {1: (1, 2), 2: (2, 1)}
    for protocol in others.get(port.protocol, (port.protocol,)):
        for baud in bauds:
            if not left or (baud, protocol) == (port.baud, port.protocol):
                continue
            bus = Bus(name, msgspec.structs.replace(port, baud=baud, protocol=protocol, fast=False))
            try:
                bus.open()
                here = bus.answering(left, _PATIENT_MS)
            except BusError:  # a rate that this adapter cannot have
                continue
            finally:
                bus.close()
            if here:
                found[baud, protocol] = here
                left = [servo for servo in left if servo not in here]
    return found


def _let_answer(bus: Bus, found: dict[int, Pong], servo: int) -> str:
    """Let a servo answer everything that answers pings only; what was done, or why not, in words.

    All models of protocol 1.0 have the register at one place.
    """
    pong = found[servo]
    usual = MODELS[0] if bus.protocol == 1 else None
    model = model_of_number(pong.model_number, bus.protocol) or usual
    if model is None or "status_return" not in model.registers:
        what = named(pong, bus.protocol)
        return f"({what}) has its status return level at a place that is unknown here"
    done = _keep(bus, servo, model, "status_return", 2)
    found |= scan_again(bus, {servo: pong}, ())
    return done


def _keep(bus: Bus, servo: int, model: ServoModel, name: str, value: int) -> str:
    """Write a register of the EEPROM; what was done, or why not, in words."""
    lock, what = model.registers.get("eeprom_lock"), name.replace("_", " ")
    locked = lock is not None and bus.get(servo, lock)
    if lock is not None and locked:
        bus.write_register(servo, lock, 0)
    done = bus.write_register(servo, model.registers[name], value)
    if lock is not None and locked:
        done = bus.write_register(servo, lock, 1) and done
    if done:
        return f"{what} set to {value}"
    return (
        f"did not take a {what} of {value}; its EEPROM may be locked, as that of a servo with "
        "protocol 2.0 that drives: switch its torque off (the leg will go limp), or its power off "
        "and on, then run with --configure again"
    )


def _again(bus: Bus, servo: int, before: Pong | None) -> Pong | None:
    """Ask a servo again whose answer did not arrive or was damaged, when the line is quiet.

    What came in between may have been a late answer to another question.
    """
    worst = before
    # Where answers come late: from the first patience to the last by doubling, and one more.
    for tries in range(6):
        if tries >= 3 and not bus.late:
            break
        if worst is not None or bus.late:
            bus.settle()
        pong = bus.ping(servo)
        if pong is not None:
            if pong.reads and not pong.doubled:
                return pong
            worst = pong
    return worst


class _Handshake:
    """Examines one port."""

    def __init__(self, plan: PortPlan, *, configure: bool, full: bool, drive: bool) -> None:
        self._plan, self._bus = plan, Bus(plan.name, plan.port)
        self._configure, self._full, self._drive = configure, full, drive
        self._port = f"port {plan.name}"
        self._where = f"port {plan.name} ({plan.port.device})"
        self._expected = {joint.servo: joint for joint in plan.joints}
        self._legs = {joint.servo: leg.id for leg in plan.legs for joint in leg.joints}
        self._findings = Findings()
        self._errors, self._advice = self._findings.errors, self._findings.advice

    def run(self) -> Findings:
        try:
            self._bus.open()
            self._compare(self._find_servos())
            self._check_settings()
        except BusError as error:
            self._errors.append(str(error))
        finally:
            self._bus.close()
        return self._findings

    def _find_servos(self) -> dict[int, Pong]:
        asked = ALL_IDS if self._full else self._expected
        ignored, expected = self._plan.port.ignore, self._expected
        configure = expected if self._configure else ()
        ids = [servo for servo in asked if servo not in ignored]
        found, lines = find_all(self._bus, ids, expected, configure)
        self._advice += [f"{self._port}: {line}" for line in lines]
        return found

    def _check_settings(self) -> None:
        plan, bus = self._plan, self._bus
        present = [] if self._errors else list(plan.joints)
        unread = [joint.servo for joint in present if not self._is_set(joint)]
        if unread:
            disturbed = "the line is disturbed: check its plugs and cable, and try again"
            self._errors.append(
                f"{self._port}: the settings of servo {', '.join(map(str, unread))} cannot be read "
                f"twice alike; {BUSY if self._many_late(unread) else disturbed}"
            )
        self._check_delays(present)
        if present and self._many_late(self._expected):
            self._advice.append(self._too_late())
        advice = latency_advice(bus.device)
        if advice is not None:
            self._advice.append(f"{self._port}: {advice}")

    def _too_late(self) -> str:
        return f"{self._port}: answers of {len(self._bus.late)} servos come too late: {BUSY}"

    def _many_late(self, servos: Iterable[int]) -> bool:
        late = [servo for servo in servos if self._bus.late[servo]]
        return len(late) >= crowd(len(self._plan.joints))

    def _compare(self, found: dict[int, Pong]) -> None:
        """Compare who is there with who should be."""
        plan, expected, where = self._plan, self._expected, self._where
        missing = [servo for servo in expected if servo not in found]
        if missing:
            self._bus.settle()  # were they late?
        patient = self._bus.port.timeout_ms >= MOST_PATIENT_MS
        if self._many_late(missing) or (patient and self._many_late(expected)):
            self._errors.append(self._too_late())
            return
        for place, ids in self._find_missing(missing).items():
            missing = [servo for servo in missing if servo not in ids]
            line = astray_text(plan.port, place, ids)
            if len(ids) == len(expected):
                line += (
                    f"; or set baud = {place[0]} and protocol = {place[1]!r} in [port.{plan.name}]"
                )
            self._errors.append(f"{where}: {line}")
        if missing and not found:
            self._errors.append(
                f"{where}: no servo answers at {plan.port.baud} baud, protocol "
                f"{plan.port.protocol}; check the servos' power, the cable and the baud rate"
            )
        elif missing:
            listed = ", ".join(f"{s} ({self._legs[s]} {expected[s].name})" for s in missing)
            self._errors.append(
                f"{where}: missing servo {listed}; check cable, power, id and baud rate"
            )
        aside = sorted({*plan.port.ignore, *(servo for servo in found if servo not in expected)})
        for servo, pong in found.items():
            trouble = self._trouble(servo, pong, aside)
            if trouble is not None:
                self._errors.append(f"{where}: {trouble}")

    def _find_missing(self, missing: Sequence[int]) -> dict[Place, list[int]]:
        """Find missing servos that answer at another rate, or in the other protocol."""
        if not missing:
            return {}
        self._bus.close()
        bauds = (*USUAL_BAUDS, *(3_000_000, 500_000, 19_200, 9_600))
        elsewhere = find_elsewhere(self._plan.name, self._plan.port, missing, bauds)
        self._bus.open()
        return elsewhere

    def _trouble(self, servo: int, pong: Pong, aside: Sequence[int]) -> str | None:
        """Return why a servo that answers is not the one expected; ``aside`` are ids of no leg."""
        joint, protocol = self._expected.get(servo), self._plan.port.protocol
        what = named(pong, protocol)
        if pong.doubled:
            return doubled_text([servo])
        if joint is None:
            model = model_of_number(pong.model_number, protocol)
            first = followed(self._bus, servo, model) if pong.reads else None
            role = "" if first is None else f", which follows servo {first} by its secondary id"
            return (
                f"unexpected servo {servo} ({what}){role}; add it to a leg, or "
                f"disconnect it, or, if it is no leg's, write ignore = {aside} in "
                f"[port.{self._plan.name}]"
            )
        if not pong.reads:
            return (
                f"servo {servo} answers to pings but not to reads; set its status return "
                "level to 2 with DYNAMIXEL Wizard, or run once with --configure"
            )
        leg, wanted = self._legs[servo], " or ".join(model.name for model in joint.models)
        who = f"servo {servo} ({leg} {joint.name})"
        if pong.model_number not in [model.number for model in joint.models]:
            return f"{who} is {what}, expected {wanted}; correct servos.model of leg '{leg}'"
        return None

    def _is_set(self, joint: JointPlan) -> bool:
        """Judge the modes of a servo; False if it does not say them reliably."""
        where, model, servo = f"{self._port}: servo {joint.servo}", joint.model, joint.servo
        data = [self._bus.confirmed(servo, block) for block in (*model.settings, model.state)]
        known = [part for part in data if part is not None]
        if len(known) < len(data):
            return False
        state = known.pop()
        found = setting(model, known)
        fatal = found.values.get("shutdown", 0)
        if standing(model, model.state, state, fatal).shut:
            self._advice.append(f"{where}: {remedy(model)}")
        wrong = found.wrong or (found.undriven if self._drive else None)
        if wrong:
            self._errors.append(f"{where} {wrong}")
        elif found.advice:
            self._advice.append(f"{where} {found.advice}")
        return True

    def _check_delays(self, joints: Sequence[JointPlan]) -> None:
        """Return delays: with the 500 us of new servos, half of the cycle is waiting."""
        slow: dict[int, int] = {}
        for joint in joints:
            register = joint.model.registers["return_delay"]
            data = self._bus.confirmed(joint.servo, register.block)
            # A step of the register is 2 us.
            delay_us = 0 if data is None else register.value(data) * 2
            if delay_us > _MOST_DELAY_US:
                slow[joint.servo] = delay_us
                if self._configure:
                    done = _keep(self._bus, joint.servo, joint.model, "return_delay", 0)
                    self._advice.append(f"{self._port}: servo {joint.servo}: {done}")
        if slow and not self._configure:
            ids = ", ".join(map(str, slow))
            self._advice.append(
                f"{self._port}: return delay of servo {ids} is {max(slow.values())} us, expected "
                f"{_MOST_DELAY_US} or less (0 is best); run once with --configure to set it"
            )
