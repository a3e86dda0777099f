"""Before a bridge starts: is everybody there, who they should be, and set as they should be?

Everything that is wrong is told in one message, and nothing for one answer alone: settings are read
in one block and twice alike, a servo that seems to be wrong is asked again when the line is quiet,
and where many answers come late, that is told, and no servo is blamed for it.  Nothing is written
to a servo's EEPROM unless ``configure`` is asked for, and then only the return delay.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from adaptive_contact.bridge.bus import MODEL_NUMBER, Bus, Pong
from adaptive_contact.bridge.modes import setting
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.bridge.port import latency_advice
from adaptive_contact.bridge.tables import Block, ServoModel, model_of_number
from adaptive_contact.bridge.wake import remedy, standing
from adaptive_contact.errors import BusError

__all__ = ["BUSY", "Findings", "check_ports", "crowd", "scan", "scan_again"]

BUSY: Final = (
    "this computer is too busy, or its adapter holds bytes back; end other programs, run with "
    "--realtime, and see 'Timing' in docs/bridge.md"
)

# A tenth of what servos are delivered with; 18 of these cost 2 ms a cycle at the most.
_MOST_DELAY_US: Final = 100
_US_PER_DELAY: Final = 2
_MORE_TRIES: Final = 3
_PATIENT_MS: Final = 25.0
_LEAST_CROWD: Final = 2


@dataclasses.dataclass
class Findings:
    """What a handshake found.

    Attributes:
        errors: why the bridge cannot run, one line each.
        advice: what to set for it to run well, one line each.
        done: what was written, with ``configure``.
    """

    errors: list[str] = dataclasses.field(default_factory=list)
    advice: list[str] = dataclasses.field(default_factory=list)
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
            lines = "".join(f"\n  - {line}" for line in self.errors)
            raise BusError(f"{len(self.errors)} things stand in the way of the bridge:{lines}")


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


def scan(bus: Bus, ids: Iterable[int] = range(MAX_ID + 1)) -> dict[int, Pong]:
    """Who answers a ping, by id.

    Raises:
        PortLostError: the port is gone.
    """
    found = {}
    for servo in ids:
        pong = bus.ping(servo)
        if pong is not None:
            found[servo] = pong
    return found


def scan_again(bus: Bus, found: dict[int, Pong], ids: Iterable[int]) -> dict[int, Pong]:
    """Ask those again, patiently, who were not heard or not heard well.

    One lost or late packet is neither a missing servo nor a second one of the same id.

    Args:
        bus: the port; its time for answers is longer afterwards.
        found: what a scan has heard.
        ids: who else may be there.

    Returns:
        Who answers, by id in order.

    Raises:
        PortLostError: the port is gone.
    """
    bus.timeout_ms = max(bus.timeout_ms, _PATIENT_MS)
    heard = dict(found)
    for servo in sorted({*ids, *found}):
        pong = heard.get(servo)
        if pong is None or pong.model_number is None or pong.doubled:
            pong = _again(bus, servo, pong)
        if pong is None:
            continue
        number = bus.confirmed(servo, MODEL_NUMBER) if pong.model_number is not None else None
        if number is not None:  # what a scan took for it may have been another answer
            pong = pong._replace(model_number=int.from_bytes(number, "little"))
        model = None if pong.model_number is None else model_of_number(pong.model_number)
        if model is not None and not pong.doubled and not _is_clear(bus, servo, model):
            pong = pong._replace(doubled=True)
        heard[servo] = pong
    return dict(sorted(heard.items()))


def _again(bus: Bus, servo: int, before: Pong | None) -> Pong | None:
    """Ask one again that was not heard, or not heard well, each time when the line is quiet.

    What came in between may have been a late answer to another question.
    """
    worst = before
    for _ in range(_MORE_TRIES):
        if before is not None:
            bus.settle()
        pong = bus.ping(servo)
        if pong is not None:
            if pong.model_number is not None and not pong.doubled:
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
        found = scan(bus, range(MAX_ID + 1) if full else expected)
        if found:  # a bus where nobody answers is asked once
            found = scan_again(bus, found, expected)
        if not set(expected) <= set(found):
            bus.settle()  # were they late?
        _compare(plan, bus, expected, found, findings)
        present = [] if findings.errors else list(plan.joints)
        unread = [j.servo for j in present if not _settings(plan, bus, j, drive, findings)]
        if unread:
            findings.errors.append(_unread(plan, bus, unread))
        _delays(plan, bus, present, configure, findings)
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
        return f"port {plan.name}: answers of {len(servos)} servos come too late: {BUSY}"
    return (
        f"port {plan.name}: the settings of servo {ids} cannot be read twice alike; the line is "
        "disturbed: check its plugs and cable, and try again"
    )


def _many_late(plan: PortPlan, bus: Bus, servos: Sequence[int]) -> bool:
    late = [servo for servo in servos if bus.late[servo]]
    return len(late) >= crowd(len(plan.joints))


def _compare(
    plan: PortPlan,
    bus: Bus,
    expected: dict[int, JointPlan],
    found: dict[int, Pong],
    findings: Findings,
) -> None:
    where = f"port {plan.name} ({bus.device})"
    legs = {joint.servo: leg.id for leg in plan.legs for joint in leg.joints}
    if not found and not _many_late(plan, bus, list(expected)):
        findings.errors.append(
            f"{where}: no servo answers at {plan.port.baud} baud, protocol {plan.port.protocol}; "
            "check the servos' power, the cable and the baud rate"
        )
        return
    missing = [servo for servo in expected if servo not in found]
    if _many_late(plan, bus, missing):
        findings.errors.append(f"{where}: answers of {len(missing)} servos come too late: {BUSY}")
    elif missing:
        told = ", ".join(f"{s} ({legs[s]} {expected[s].name})" for s in missing)
        findings.errors.append(
            f"{where}: missing servo {told}; check cable, power, id and baud rate"
        )
    for servo, pong in found.items():
        joint = expected.get(servo)
        number = pong.model_number
        model = None if number is None else model_of_number(number)
        name = model.name if model else f"model number {number}"
        if pong.doubled:
            findings.errors.append(
                f"{where}: several servos answer to id {servo} (or its line is disturbed); connect "
                "them one by one and give each an id of its own"
            )
        elif joint is None:
            findings.errors.append(
                f"{where}: unexpected servo {servo} ({name}); add it to a leg, or disconnect it"
            )
        elif number is None:
            findings.errors.append(
                f"{where}: servo {servo} answers to pings but not to reads; set its status return "
                "level to 2 with DYNAMIXEL Wizard"
            )
        elif number not in [m.number for m in joint.models]:
            wanted = " or ".join(m.name for m in joint.models)
            findings.errors.append(
                f"{where}: servo {servo} ({legs[servo]} {joint.name}) is {name}, expected "
                f"{wanted}; correct servos.model of leg '{legs[servo]}'"
            )


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
        data = bus.confirmed(joint.servo, Block(register.address, register.size))
        if data is None or data[0] * _US_PER_DELAY <= _MOST_DELAY_US:
            continue
        delay = data[0] * _US_PER_DELAY
        slow[joint.servo] = delay
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
    torque = bus.get(servo, registers["torque_enable"])
    if torque and joint.model.protocol == 2:
        # X-series lock their EEPROM while they drive; letting go would drop the robot.
        findings.advice.append(
            f"port {plan.name}: servo {servo} drives, so its return delay cannot be set; switch "
            "its torque off first (the leg will go limp), then run with --configure again"
        )
        return
    if bus.put(servo, registers["return_delay"], 0):
        findings.done.append(f"port {plan.name}: servo {servo}: return delay set to 0")
    else:
        findings.advice.append(f"port {plan.name}: servo {servo} refused a return delay of 0")
