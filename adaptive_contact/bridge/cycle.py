"""One control tick of a port: read, command, sample.

In *observe* mode nothing is ever written: goals are read along with the positions.  In *drive*
mode the positions are read first, then the newest commands are limited and written with one sync
write; a sample pairs the two, as the wire's contract wants it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final, Literal

from adaptive_contact.bridge.bus import Bus, Reading
from adaptive_contact.bridge.drive import EASY_SHARE, Driver, Mode, complaint
from adaptive_contact.bridge.health import SILENT_AFTER, Punctuality, ServoHealth, due, is_stale
from adaptive_contact.bridge.outlet import Mailbox
from adaptive_contact.bridge.plan import JointPlan, LegPlan, PortPlan
from adaptive_contact.bridge.status import ServoCounts
from adaptive_contact.bridge.wake import Standing, standing
from adaptive_contact.wire import ServoSample

__all__ = ["Cycle"]

# A second try after a wrong checksum has to begin within this share of the control period.
_RETRY_SHARE: Final = 0.4
# Readings end this share of the period after the tick was due, whoever is silent, so that goals
# and samples go out in time; a tick that began late has the other share at the least.
_END_SHARE, _LEAST_SHARE = 0.9, 0.4
# A servo that has shut itself down is looked at again after so long.
_LOOK_S: Final = 1.0
# A goal this close to where a servo is, or within one step of the easy pace, is where it is.
_NEAR_STEPS: Final = 2
# What alarms are about is asked for this share of the period at most, after the tick's own work.
_ASK_SHARE: Final = 0.3


@dataclasses.dataclass
class _Servo:
    """What is known of a servo.

    Attributes:
        joint: it is of.
        steps: position, as it was last read.
        goal: in force, steps.
        awake: it has torque and goals from us.
        look_at: cycle from which on a servo that has shut itself down is looked at again.
    """

    joint: JointPlan
    steps: int | None = None
    off_rad: float = 0.0  # from the position read to where it was at its moment of the tick
    speed_rad_s: float = 0.0
    goal: int | None = None
    last_goal: int | None = None
    valid: bool = False
    awake: bool = False
    look_at: int = 0
    punctual: Punctuality = dataclasses.field(default_factory=Punctuality)

    @property
    def angle(self) -> float | None:
        if self.steps is None:
            return None
        return self.joint.angle(self.steps) + self.joint.direction * self.off_rad


class Cycle:
    """The control ticks of one port.

    Args:
        plan: what is on the port.
        bus: the port, open.
        mode: ``observe`` or ``drive``.
        mailbox: commands, for drive mode.
        run: the ``run`` of the samples.
    """

    def __init__(
        self,
        plan: PortPlan,
        bus: Bus,
        mode: Literal["observe", "drive"],
        mailbox: Mailbox,
        run: int,
    ) -> None:
        self.plan = plan
        self.bus = bus
        self.mode = mode
        self._mailbox = mailbox
        self._run = run
        self._model = plan.joints[0].model
        self._servos = {joint.servo: _Servo(joint) for joint in plan.joints}
        self.health = {joint.servo: ServoHealth() for joint in plan.joints}
        self._drivers = {leg.id: Driver(leg) for leg in plan.legs} if mode == "drive" else {}
        self._lacking: dict[str, list[int]] = {}
        self._look_every = round(_LOOK_S / plan.period_s)
        self._until_s = self._end_s = 0.0
        self._count = 0
        self._hurry_until = 0

    @property
    def holding(self) -> list[str]:
        """Legs whose commands have stopped."""
        return [leg for leg, driver in self._drivers.items() if driver.mode is Mode.HOLDING]

    @property
    def lacking(self) -> dict[str, str]:
        """What is to be told of legs that have commands but not all their servos, by leg."""
        told = {}
        for leg, servos in self._lacking.items():
            if servos:
                names = ", ".join(f"{servo} ({self._trouble(servo)})" for servo in servos)
                begun = self._drivers[leg].goal is not None
                does = "goes on without" if begun else "commands wait for"
                told[leg] = f"leg {leg}: {does} servo {names}"
        return told

    @property
    def limited(self) -> int:
        """Commands that limits or the largest step cut down."""
        return sum(driver.limited for driver in self._drivers.values())

    @property
    def counts(self) -> dict[str, ServoCounts]:
        """What there is to tell of the servos, by id."""
        told = {str(servo): record.counts for servo, record in self.health.items()}
        return {servo: counts for servo, counts in told.items() if counts is not None}

    def restart(self) -> None:
        """Rely on nothing after an outage: servos may have been moved, or have lost their goals.

        What was last known of them stays in the samples, marked invalid, so that a leg with a
        servo that does not come back is still there.
        """
        for servo in self._servos.values():
            servo.last_goal = None
            servo.speed_rad_s = 0.0
            servo.awake = servo.valid = False
        for record in self.health.values():
            # Who was silent is asked, and told of, as one who is until it answers.
            record.misses = SILENT_AFTER - 1 if record.silent else 0
        for driver in self._drivers.values():
            driver.forget()
        self._lacking.clear()

    def tick(self, t_ns: int, seq: int, now_ns: int, due_ns: int) -> dict[str, ServoSample]:
        """Make one control tick.

        Args:
            t_ns: wall clock, for the samples.
            seq: number of the tick.
            now_ns: monotonic.
            due_ns: monotonic time at which the tick should have begun.

        Returns:
            A sample of every leg whose servos have all been heard at least once.

        Raises:
            PortLostError: the port is gone.
        """
        self._read(now_ns, due_ns)
        if self.mode == "drive":
            self._write(now_ns)
        self._count += 1
        samples = (self._sample(leg, t_ns, seq) for leg in self.plan.legs)
        return {leg.id: s for leg, s in zip(self.plan.legs, samples, strict=True) if s is not None}

    def moving_goal(self) -> JointPlan | None:
        """The joint whose goal moved most from the tick before to the last, if one did."""
        best, largest = None, 0
        for servo in self._servos.values():
            if servo.goal is not None and servo.last_goal is not None and servo.valid:
                moved = abs(servo.goal - servo.last_goal)
                if moved > largest:
                    best, largest = servo.joint, moved
        return best

    def goal_of(self, joint: JointPlan) -> tuple[int | None, int | None]:
        """Goal of a joint at the last reading, and at the one before, steps."""
        servo = self._servos[joint.servo]
        return (servo.goal, servo.last_goal) if servo.valid else (None, None)

    def ask_alarms(self, now_ns: int) -> None:
        """Ask servos that complain what is wrong, and whether they still drive; now and then.

        Those for whom there is no time before the next tick have their turn another time.
        """
        asked = [
            number
            for number, record in self.health.items()
            if not record.silent and (record.shut or record.endangered)
        ]
        if not asked:
            return
        first = self._count % len(asked)
        end_s = now_ns / 1e9 + _ASK_SHARE * self.plan.period_s
        readings = self.bus.read(asked[first:] + asked[:first], self._model.state, 0.0, end_s)
        for number, reading in readings.items():
            if reading.data is not None:
                stands = standing(self._model, reading.data)
                if stands.alarms:
                    self.health[number].alarm(stands.alarms)
                self._judge(self._servos[number], stands)

    # -- private -------------------------------------------------------------------------------

    def _read(self, now_ns: int, due_ns: int) -> None:
        # Goals are read where they are not known: by an observer always, by a driver at first.
        known = self.mode == "drive" and all(d.goal is not None for d in self._drivers.values())
        block = self._model.motion if known else self._model.goal_and_motion
        asked = due(self.health, self._count, hurry=self._count < self._hurry_until)
        now_s, period_s = now_ns / 1e9, self.plan.period_s
        self._until_s = now_s + _RETRY_SHARE * period_s
        self._end_s = max(due_ns / 1e9 + _END_SHARE * period_s, now_s + _LEAST_SHARE * period_s)
        readings = self.bus.read(asked, block, self._until_s, self._end_s)
        for number, servo in self._servos.items():
            servo.last_goal = servo.goal
            reading = readings.get(number)
            if reading is None:  # not asked, or no time was left
                servo.valid = False
                continue
            was_silent = self.health[number].silent
            self.health[number].note(reading)
            if was_silent and reading.data is not None:
                # Power has come back, it seems: ask the others at once.
                self._hurry_until = self._count + len(self._servos) + 1
            # Of a silent one nobody knows where it is: not moved, nor woken by a goal.
            servo.awake &= not self.health[number].silent
            servo.valid = reading.data is not None and self._take(servo, reading, known, due_ns)

    def _take(self, servo: _Servo, reading: Reading, known: bool, due_ns: int) -> bool:
        """Take a reading's values; False if the position is not one of this tick."""
        assert reading.data is not None
        model, registers = self._model, self._model.registers
        block = model.motion if known else model.goal_and_motion
        steps = block.part(reading.data, registers["present_position"])
        speed = model.signed_speed(block.part(reading.data, registers["present_speed"]))
        if not known:
            servo.goal = block.part(reading.data, registers["goal_position"])
        stale = servo.steps is not None and is_stale(
            steps, servo.steps, speed, servo.speed_rad_s, model.step_rad / self.plan.period_s
        )
        servo.steps, servo.speed_rad_s = steps, speed
        faults = self.health[servo.joint.servo].faults
        if stale:
            faults["stale"] += 1
        due_s = due_ns / 1e9
        correction = servo.punctual.correction(
            reading.at_s - due_s, reading.till_s - due_s, speed, model.step_rad
        )
        servo.off_rad = correction or 0.0
        if correction is None:
            faults["unpunctual"] += 1
        elif correction:
            faults["carried_back"] += 1
        return correction is not None and not stale

    def _write(self, now_ns: int) -> None:
        registers = self._model.registers
        goals: dict[int, int] = {}
        for leg in self.plan.legs:
            driver = self._drivers[leg.id]
            self._hear(leg, driver)
            servos = [self._servos[joint.servo] for joint in leg.joints]
            found = self._look(servos) if driver.is_asked(now_ns) else {}
            start: list[float | None] = []
            for j, servo in enumerate(servos):
                stands = found.get(servo.joint.servo)
                if stands is not None:
                    if stands.torque:
                        servo.goal = stands.goal
                    at = servo.joint.angle(stands.goal) if stands.torque else servo.angle
                    assert at is not None
                    driver.found(j, at)
                    start.append(at)
                elif servo.awake and servo.goal is not None:
                    start.append(servo.joint.angle(servo.goal))
                else:
                    start.append(None)
            absent = [j for j, servo in enumerate(servos) if self._is_absent(servo)]
            goal = driver.step(start, now_ns, absent)
            lacks = [s.joint.servo for s in servos if not s.awake and s.joint.servo not in found]
            if goal is None:  # none of them is driven
                lacks = [s.joint.servo for s, at in zip(servos, start, strict=True) if at is None]
            self._lacking[leg.id] = lacks if driver.is_asked(now_ns) else []
            if goal is None:
                continue
            self._wake(leg, found)
            for servo, angle in zip(servos, goal, strict=True):
                stands = found.get(servo.joint.servo)
                servo.awake |= stands is not None and stands.torque
                if servo.awake:
                    servo.goal = goals[servo.joint.servo] = servo.joint.steps(angle)
        self.bus.put_all(registers["goal_position"], goals)

    def _wake(self, leg: LegPlan, found: Mapping[int, Standing]) -> None:
        """Let servos without torque hold where they are, so that nothing jumps.

        Sync writes are not answered.  So torque comes on a tick after the goal, where this tick's
        look has seen that goal in the register, and goals follow once it has seen the torque: of
        a write that was lost there is nothing but another tick to wait.
        """
        near = max(_NEAR_STEPS, int(EASY_SHARE * leg.max_step_rad / self._model.step_rad))
        here: dict[int, int] = {}
        ready: dict[int, int] = {}
        for number, stands in found.items():
            servo = self._servos[number]
            if stands.torque or servo.steps is None:
                continue
            if abs(stands.goal - servo.steps) <= near:
                ready[number] = 1
            else:
                servo.goal = here[number] = servo.steps
        self.bus.put_all(self._model.registers["goal_position"], here)
        self.bus.put_all(self._model.registers["torque_enable"], ready)

    def _look(self, servos: Sequence[_Servo]) -> dict[int, Standing]:
        """How those stand that are to be woken; one that cannot be is left out."""
        asked = []
        for servo in servos:
            record = self.health[servo.joint.servo]
            looked_at = servo.valid and not record.silent and self._count >= servo.look_at
            if looked_at and not servo.awake:
                asked.append(servo.joint.servo)
        if not asked:
            return {}
        found = {}
        readings = self.bus.read(asked, self._model.state, self._until_s, self._end_s)
        for number, reading in readings.items():
            if reading.data is None:
                continue
            stands = standing(self._model, reading.data)
            self._judge(self._servos[number], stands)
            if not stands.shut:
                found[number] = stands
        return found

    def _is_absent(self, servo: _Servo) -> bool:
        record = self.health[servo.joint.servo]
        return record.silent or record.shut

    def _trouble(self, number: int) -> str:
        record = self.health[number]
        if record.silent:
            return "no answer"
        return "shut down" if record.shut else "not read yet"

    def _judge(self, servo: _Servo, stands: Standing) -> None:
        """Note whether a servo has shut itself down; it gets no goals then."""
        self.health[servo.joint.servo].shut = stands.shut
        if stands.shut:
            servo.awake = False
            servo.look_at = self._count + self._look_every

    def _hear(self, leg: LegPlan, driver: Driver) -> None:
        taken = self._mailbox.take(leg.id)
        if taken is None:
            return
        command, arrival_ns = taken
        wrong = complaint(command, len(leg.joints))
        if wrong is not None:
            self._mailbox.refuse(f"leg '{leg.id}': {wrong}")
            return
        driver.hear(command, arrival_ns)

    def _sample(self, leg: LegPlan, t_ns: int, seq: int) -> ServoSample | None:
        servos = [self._servos[joint.servo] for joint in leg.joints]
        measured, desired = [], []
        for servo in servos:
            if servo.angle is None or servo.goal is None:
                return None
            measured.append(servo.angle)
            desired.append(servo.joint.angle(servo.goal))
        valid = [servo.valid for servo in servos]
        driver = self._drivers.get(leg.id)
        return ServoSample(
            t_ns=t_ns,
            seq=seq,
            measured=measured,
            desired=desired,
            preview=None if driver is None else driver.preview,
            valid=None if all(valid) else valid,
            run=self._run,
        )
