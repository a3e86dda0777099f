"""Check servos before a bridge starts: are they all there, the right ones, and set rightly?

One message reports everything that is wrong, and nothing because of one answer alone; what is
looked for, and what ``configure`` writes: docs/bridge.md, "The handshake".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, Literal

import msgspec

from adaptive_contact.bridge.bus import MODEL_NUMBER, MOST_PATIENT_MS, Bus, Pong
from adaptive_contact.bridge.drive import remedy, standing
from adaptive_contact.bridge.modes import setting
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.bridge.port import latency_advice
from adaptive_contact.bridge.tables import (
    FEETECH_MARK,
    MODELS,
    ServoModel,
    feetech_name,
    model_of_number,
    number_name,
)
from adaptive_contact.errors import BusError
from adaptive_contact.robot import Port

ALL_IDS: Final = range(MAX_ID + 1)
# A baud rate, and a protocol.
Place = tuple[int, Literal[1, 2]]

# Rates that servos are delivered with, and those set most; then others that they can have.
USUAL_BAUDS: Final = (1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
_OTHER_BAUDS: Final = (3_000_000, 500_000, 19_200, 9_600)
# The usual status return level: a servo answers everything.
_ANSWER_ALL: Final = 2
ANSWERS_NOW: Final = f"status return level set to {_ANSWER_ALL}"

BUSY: Final = (
    "this computer is too busy, or its adapter holds bytes back; end other programs, run with "
    "--realtime, and see 'Timing' in docs/bridge.md"
)

# A tenth of what servos are delivered with; 18 of these cost 2 ms a cycle at the most.
_MOST_DELAY_US: Final = 100
_US_PER_DELAY: Final = 2
_MORE_TRIES: Final = 3
# Where answers come late: from the first patience to the last by doubling, and one more.
_LATE_TRIES: Final = 6
_PATIENT_MS: Final = 25.0
_LEAST_CROWD: Final = 2


@dataclasses.dataclass
class Findings:
    """What a handshake found."""

    # why the bridge cannot run, one line each
    errors: list[str] = dataclasses.field(default_factory=list)
    # what to set for it to run well, one line each
    advice: list[str] = dataclasses.field(default_factory=list)
    # what was written, with ``configure``
    done: list[str] = dataclasses.field(default_factory=list)

    def add(self, other: Findings) -> None:
        """Take in those of another port."""
        self.errors += other.errors
        self.advice += other.advice
        self.done += other.done

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
    """How many servos of a port are too many to be silent at once each for a reason of its own."""
    return max(_LEAST_CROWD, (servos + 1) // 2)


def check_ports(
    plans: Sequence[PortPlan], *, configure: bool = False, full: bool = True, drive: bool = False
) -> Findings:
    """Shake hands on all ports, each on a thread of its own.

    Args:
        plans: what is expected where.
        configure: write what should be set differently, EEPROM included.
        full: look for unexpected servos too, which takes about a second.
        drive: they are to be driven, not only observed.
    """
    with ThreadPoolExecutor(max_workers=len(plans)) as pool:
        results = list(pool.map(lambda plan: _check(plan, configure, full, drive), plans))
    findings = Findings()
    for result in results:
        findings.add(result)
    return findings


def scan(bus: Bus, ids: Iterable[int] | None = None) -> dict[int, Pong]:
    """Ping servos; who answers, by id.

    Args:
        bus: the port.
        ids: whom; all that there may be without.

    Raises:
        PortLostError: the port is gone.
    """
    found = {}
    for servo in ALL_IDS if ids is None else ids:
        pong = bus.ping(servo)
        if pong is not None:
            found[servo] = pong
    return found


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
    bus.timeout_ms = max(bus.timeout_ms, _PATIENT_MS)
    pongs = dict(found)
    for servo in sorted({*ids, *found}):
        pong = pongs.get(servo)
        if pong is None or not pong.reads or pong.doubled:
            pong = _again(bus, servo, pong)
        if pong is None:
            continue
        number = bus.confirmed(servo, MODEL_NUMBER) if pong.reads else None
        if number is not None:  # what a scan took for it may have been another answer
            pong = pong._replace(model_number=int.from_bytes(number, "little"))
        model = None if pong.model_number is None else model_of_number(pong.model_number)
        if model is None and pong.reads and bus.protocol == 1:
            mark = bus.confirmed(servo, FEETECH_MARK)
            pong = pong._replace(brand=None if mark is None else feetech_name(mark, servo))
        if model is not None and not pong.doubled and not _is_clear(bus, servo, model):
            pong = pong._replace(doubled=True)
        pongs[servo] = pong
    return dict(sorted(pongs.items()))


def named(pong: Pong) -> str:
    """What a servo is, in words."""
    if pong.brand is not None:
        return pong.brand
    return "answers pings only" if pong.model_number is None else number_name(pong.model_number)


def look_elsewhere(
    name: str, port: Port, ids: Sequence[int], bauds: Sequence[int] = USUAL_BAUDS
) -> dict[Place, list[int]]:
    """Look for servos that do not answer as the port is set; writes nothing.

    Args:
        name: of the port.
        port: as it is set; closed.
        ids: whom to look for.
        bauds: rates to try, in both protocols.

    Returns:
        Ids by the baud rate and the protocol at which they answer.
    """
    found: dict[Place, list[int]] = {}
    left = list(ids)
    other: Literal[1, 2] = 2 if port.protocol == 1 else 1
    for protocol in (port.protocol, other):
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


def let_answer(
    bus: Bus, found: dict[int, Pong], servo: int, model: ServoModel | None = None
) -> str | None:
    """Let a servo answer everything that answers pings only: write its status return level.

    Args:
        bus: its port.
        found: who answers; the servo's pong is replaced by what it answers then.
        servo: which.
        model: what it is expected to be; all models of protocol 1.0 have the register at one place.

    Returns:
        Why that was not done, in words; None when it was.

    Raises:
        PortLostError: the port is gone.
    """
    pong = found[servo]
    own = None if pong.model_number is None else model_of_number(pong.model_number)
    model = own or model or (MODELS[0] if bus.protocol == 1 else None)
    if model is None:
        return f"({named(pong)}) has its status return level at a place that is unknown here"
    register = model.registers["status_return"]
    if bus.put(servo, register, _ANSWER_ALL):
        again = bus.ping(servo)
        if again is not None:
            found |= scan_again(bus, {servo: again}, ())
        return None
    torque = "torque off first (the leg will go limp)"
    remedy = torque if register.eeprom and model.protocol == 2 else "power off and on"
    return f"did not take a status return level of {_ANSWER_ALL}; switch its {remedy}"


def _again(bus: Bus, servo: int, before: Pong | None) -> Pong | None:
    """Ask a servo again whose answer did not arrive or was damaged, when the line is quiet.

    What came in between may have been a late answer to another question.
    """
    worst = before
    for tries in range(_LATE_TRIES):
        if tries >= _MORE_TRIES and not bus.late:
            break
        if worst is not None or bus.late:
            bus.settle()
        pong = bus.ping(servo)
        if pong is not None:
            if pong.reads and not pong.doubled:
                return pong
            worst = pong
    return worst


def _is_clear(bus: Bus, servo: int, model: ServoModel) -> bool:
    """Whether a servo can be understood; asked again on a quiet line before it is denied."""
    if bus.is_clear(servo, model.measured):
        return True
    bus.settle()
    return bus.is_clear(servo, model.measured)


def _check(plan: PortPlan, configure: bool, full: bool, drive: bool) -> Findings:
    findings = Findings()
    bus = Bus(plan.name, plan.port)
    try:
        bus.open()
    except BusError as error:
        findings.errors.append(str(error))
        return findings
    try:
        expected = {joint.servo: joint for joint in plan.joints}
        asked = ALL_IDS if full else expected
        found = scan(bus, [servo for servo in asked if servo not in plan.port.ignore])
        if not found:
            bus.settle(MOST_PATIENT_MS)  # were they late?
        if found or bus.late:  # a bus without an answer is asked once
            found = scan_again(bus, found, {*expected, *bus.late})
        mute = [s for s, pong in found.items() if s in expected and not pong.reads]
        for servo in mute if configure else ():
            trouble = let_answer(bus, found, servo, expected[servo].model)
            if trouble is None:
                findings.done.append(f"port {plan.name}: servo {servo}: {ANSWERS_NOW}")
            else:
                findings.advice.append(f"port {plan.name}: servo {servo} {trouble}")
        missing = [servo for servo in expected if servo not in found]
        elsewhere: dict[Place, list[int]] = {}
        if missing:
            bus.settle()  # were they late?
            if not _many_late(plan, bus, missing):
                bus.close()
                bauds = (*USUAL_BAUDS, *_OTHER_BAUDS)
                elsewhere = look_elsewhere(plan.name, plan.port, missing, bauds)
                bus.open()
        _compare(plan, bus, expected, found, elsewhere, findings)
        present = [] if findings.errors else list(plan.joints)
        unread = [j.servo for j in present if not _settings(plan, bus, j, drive, findings)]
        if unread:
            findings.errors.append(_unread(plan, bus, unread))
        _delays(plan, bus, present, configure, findings)
        slow = _slow(plan, bus, present) if bus.late else []
        if len(slow) >= crowd(len(plan.joints)):
            findings.advice.append(_too_late(plan, len(slow)))
        advice = latency_advice(bus.device)
        if advice is not None:
            findings.advice.append(f"port {plan.name}: {advice}")
    except BusError as error:
        findings.errors.append(str(error))
    finally:
        bus.close()
    return findings


def _unread(plan: PortPlan, bus: Bus, servos: Sequence[int]) -> str:
    """What to say of servos that are there, and whose registers cannot be read reliably."""
    ids = ", ".join(map(str, servos))
    if _many_late(plan, bus, servos):
        return _too_late(plan, len(servos))
    return (
        f"port {plan.name}: the settings of servo {ids} cannot be read twice alike; the line is "
        "disturbed: check its plugs and cable, and try again"
    )


def _too_late(plan: PortPlan, count: int) -> str:
    return f"port {plan.name}: answers of {count} servos come too late: {BUSY}"


def _slow(plan: PortPlan, bus: Bus, joints: Sequence[JointPlan]) -> list[int]:
    """Servos that never answer within the port's time, however quiet the line and the computer."""
    slow = []
    for joint in joints:
        taken_s = (
            answer.till_s - answer.at_s
            for answer in bus.ask_often(joint.servo, joint.model.measured)
            if answer.data is not None
        )
        if min(taken_s, default=0.0) > plan.port.timeout_ms / 1000.0:
            slow.append(joint.servo)
    return slow


def _many_late(plan: PortPlan, bus: Bus, servos: Sequence[int]) -> bool:
    late = [servo for servo in servos if bus.late[servo]]
    return len(late) >= crowd(len(plan.joints))


def _compare(
    plan: PortPlan,
    bus: Bus,
    expected: dict[int, JointPlan],
    found: dict[int, Pong],
    elsewhere: dict[Place, list[int]],
    findings: Findings,
) -> None:
    where = f"port {plan.name} ({bus.device})"
    if bus.timeout_ms >= MOST_PATIENT_MS and _many_late(plan, bus, list(expected)):
        findings.errors.append(_too_late(plan, len(expected)))
        return
    legs = {joint.servo: leg.id for leg in plan.legs for joint in leg.joints}
    astray = [servo for ids in elsewhere.values() for servo in ids]
    if not found and not _many_late(plan, bus, list(expected)):
        remedy = "check the servos' power, the cable and the baud rate"
        if astray:
            remedy = "; ".join(_elsewhere(plan, place, ids) for place, ids in elsewhere.items())
        findings.errors.append(
            f"{where}: no servo answers at {plan.port.baud} baud, protocol {plan.port.protocol}; "
            f"{remedy}"
        )
        return
    findings.errors += [
        f"{where}: {_elsewhere(plan, place, ids)}" for place, ids in elsewhere.items()
    ]
    missing = [servo for servo in expected if servo not in found and servo not in astray]
    if _many_late(plan, bus, missing):
        findings.errors.append(_too_late(plan, len(missing)))
    elif missing:
        listed = ", ".join(f"{s} ({legs[s]} {expected[s].name})" for s in missing)
        findings.errors.append(
            f"{where}: missing servo {listed}; check cable, power, id and baud rate"
        )
    aside = sorted({*plan.port.ignore, *(servo for servo in found if servo not in expected)})
    for servo, pong in found.items():
        joint = expected.get(servo)
        number = pong.model_number
        if pong.doubled:
            findings.errors.append(
                f"{where}: several servos answer to id {servo} (or its line is disturbed); connect "
                "them one by one and give each an id of its own"
            )
        elif joint is None:
            findings.errors.append(
                f"{where}: unexpected servo {servo} ({named(pong)}); add it to a leg, or "
                f"disconnect it, or, if it is no leg's, write ignore = {aside} in "
                f"[port.{plan.name}]"
            )
        elif not pong.reads:
            findings.errors.append(
                f"{where}: servo {servo} answers to pings but not to reads; set its status return "
                "level to 2 with DYNAMIXEL Wizard, or run once with --configure"
            )
        elif pong.brand is not None:
            wanted = " or ".join(m.name for m in joint.models)
            findings.errors.append(
                f"{where}: servo {servo} ({legs[servo]} {joint.name}) is a {pong.brand}, expected "
                f"{wanted}; this bridge cannot drive it"
            )
        elif number not in [m.number for m in joint.models]:
            wanted = " or ".join(m.name for m in joint.models)
            findings.errors.append(
                f"{where}: servo {servo} ({legs[servo]} {joint.name}) is {named(pong)}, expected "
                f"{wanted}; correct servos.model of leg '{legs[servo]}'"
            )


def _elsewhere(plan: PortPlan, place: Place, ids: Sequence[int]) -> str:
    """What to say of servos that answer at another rate, or in the other protocol."""
    baud, protocol = place
    own = f"{plan.port.baud} baud, protocol {plan.port.protocol}"
    listed = f"servo {', '.join(map(str, ids))}"
    does = "answers" if len(ids) == 1 else "answer"
    if set(ids) == {joint.servo for joint in plan.joints}:
        remedy = f"set baud = {baud} and protocol = {protocol} in [port.{plan.name}]"
    else:
        what = "baud rate" if protocol == plan.port.protocol else "baud rate and protocol"
        remedy = f"set its {what} with DYNAMIXEL Wizard, as all servos of a port have one"
    return f"{listed} {does} at {baud} baud, protocol {protocol}, not at {own}; {remedy}"


def _settings(plan: PortPlan, bus: Bus, joint: JointPlan, drive: bool, findings: Findings) -> bool:
    """Modes in which goals would not be followed; False if the servo does not say reliably."""
    where, model, servo = f"port {plan.name}: servo {joint.servo}", joint.model, joint.servo
    data = [bus.confirmed(servo, block) for block in (*model.settings, model.state)]
    known = [part for part in data if part is not None]
    if len(known) < len(data):
        return False
    if standing(model, model.state, known.pop()).shut:
        findings.advice.append(f"{where}: {remedy(model)}")
    found = setting(model, known)
    wrong = found.wrong or (found.undriven if drive else None)
    if wrong:
        findings.errors.append(f"{where} {wrong}")
    elif found.advice:
        findings.advice.append(f"{where} {found.advice}")
    return True


def _delays(
    plan: PortPlan, bus: Bus, joints: Sequence[JointPlan], configure: bool, findings: Findings
) -> None:
    """Return delays: with the 500 us of new servos, half of the cycle is waiting."""
    slow: dict[int, int] = {}
    for joint in joints:
        register = joint.model.registers["return_delay"]
        data = bus.confirmed(joint.servo, register.block)
        delay_us = 0 if data is None else register.value(data) * _US_PER_DELAY
        if delay_us <= _MOST_DELAY_US:
            continue
        slow[joint.servo] = delay_us
        if configure:
            _configure(plan, bus, joint, findings)
    if slow and not configure:
        ids = ", ".join(str(servo) for servo in slow)
        findings.advice.append(
            f"port {plan.name}: return delay of servo {ids} is {max(slow.values())} us, expected "
            f"{_MOST_DELAY_US} or less (0 is best); run once with --configure to set it"
        )


def _configure(plan: PortPlan, bus: Bus, joint: JointPlan, findings: Findings) -> None:
    registers, servo = joint.model.registers, joint.servo
    if joint.model.protocol == 2 and bus.get(servo, registers["torque_enable"]):
        # Those of protocol 2.0 lock their EEPROM while they drive; letting go would drop the robot.
        findings.advice.append(
            f"port {plan.name}: servo {servo} drives, so its return delay cannot be set; switch "
            "its torque off first (the leg will go limp), then run with --configure again"
        )
        return
    if bus.put(servo, registers["return_delay"], 0):
        findings.done.append(f"port {plan.name}: servo {servo}: return delay set to 0")
    else:
        findings.advice.append(
            f"port {plan.name}: servo {servo} did not take a return delay of 0; its EEPROM may be "
            "locked: switch its power off and on, then run with --configure again"
        )
