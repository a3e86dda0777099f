"""Before a bridge starts: is everybody there, who they should be, and set as they should be?

Everything that is wrong is told in one message.  Nothing is written to a servo's EEPROM unless
``configure`` is asked for, and then only the return delay.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from adaptive_contact.bridge.bus import Bus, Pong
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.bridge.port import latency_advice
from adaptive_contact.bridge.tables import model_of_number
from adaptive_contact.bridge.wake import remedy, standing
from adaptive_contact.errors import BusError

__all__ = ["Findings", "check_ports", "scan", "scan_again"]

# A tenth of what servos are delivered with; 18 of these cost 2 ms a cycle at the most.
_MOST_DELAY_US: Final = 100
_US_PER_DELAY: Final = 2
_MORE_TRIES: Final = 2
_PATIENT_MS: Final = 25.0


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


def check_ports(
    plans: Sequence[PortPlan], *, configure: bool = False, full: bool = True
) -> Findings:
    """Shake hands on all ports, each on a thread of its own.

    Args:
        plans: what is expected where.
        configure: write what should be set differently, EEPROM included.
        full: look for unexpected servos too, which takes about a second.
    """
    with ThreadPoolExecutor(max_workers=len(plans)) as pool:
        results = list(pool.map(lambda plan: _check(plan, configure, full), plans))
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
    asked = {*ids, *found}
    for _ in range(_MORE_TRIES):
        sure = [s for s, pong in heard.items() if pong.model_number is not None]
        heard |= scan(bus, sorted(s for s in asked if s not in sure or heard[s].doubled))
    for servo, pong in heard.items():
        model = None if pong.model_number is None else model_of_number(pong.model_number)
        if model is not None and not pong.doubled and not bus.is_clear(servo, model.measured):
            heard[servo] = pong._replace(doubled=True)
    return dict(sorted(heard.items()))


def _check(plan: PortPlan, configure: bool, full: bool) -> Findings:
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
        _compare(plan, bus, expected, found, findings)
        present = [] if findings.errors else list(plan.joints)
        for joint in present:
            _settings(plan, bus, joint, findings)
        _delays(plan, bus, present, configure, findings)
        advice = latency_advice(bus.device)
        if advice is not None:
            findings.advice.append(f"port {plan.name}: {advice}")
    except BusError as error:
        findings.errors.append(str(error))
    finally:
        bus.close()
    return findings


def _compare(
    plan: PortPlan,
    bus: Bus,
    expected: dict[int, JointPlan],
    found: dict[int, Pong],
    findings: Findings,
) -> None:
    where = f"port {plan.name} ({bus.device})"
    legs = {joint.servo: leg.id for leg in plan.legs for joint in leg.joints}
    if not found:
        findings.errors.append(
            f"{where}: no servo answers at {plan.port.baud} baud, protocol {plan.port.protocol}; "
            "check the servos' power, the cable and the baud rate"
        )
        return
    missing = [servo for servo in expected if servo not in found]
    if missing:
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


def _settings(plan: PortPlan, bus: Bus, joint: JointPlan, findings: Findings) -> None:
    """Modes in which goals would not be followed."""
    where, model, servo = f"port {plan.name}: servo {joint.servo}", joint.model, joint.servo
    state = bus.read([servo], model.state)[servo].data
    if state is not None and standing(model, state).shut:
        findings.advice.append(f"{where}: {remedy(model)}")
    if model.position_mode is not None:
        mode = bus.get(servo, model.registers["operating_mode"])
        if mode not in (None, model.position_mode):
            findings.errors.append(
                f"{where} is in operating mode {mode}, expected {model.position_mode} (position); "
                "set it with DYNAMIXEL Wizard"
            )
    else:
        limits = [bus.get(servo, model.registers[n]) for n in ("lower_limit", "upper_limit")]
        if limits == [0, 0]:
            findings.errors.append(
                f"{where} is in wheel mode (both angle limits are 0); set limits, such as "
                f"{model.lowest} and {model.highest}, with DYNAMIXEL Wizard"
            )


def _delays(
    plan: PortPlan, bus: Bus, joints: Sequence[JointPlan], configure: bool, findings: Findings
) -> None:
    """Return delays: with the 500 us of new servos, half of the cycle is waiting."""
    slow: dict[int, int] = {}
    for joint in joints:
        register = joint.model.registers["return_delay"]
        delay = (bus.get(joint.servo, register) or 0) * _US_PER_DELAY
        if delay <= _MOST_DELAY_US:
            continue
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
