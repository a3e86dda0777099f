"""Runs one control tick of a port: read, command, sample.

In *observe* mode nothing is ever written: goals are read along with the positions.  In *drive*
mode goals and positions are read first, then the newest commands are limited and written with one
sync write; a sample pairs the two, as the wire's contract wants it.  A servo that did not answer in
this tick gets no goal in it: what it holds, and whether it drives, is not known then.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

from adaptive_contact.bridge.bus import Bus, Reading
from adaptive_contact.bridge.drive import (
    Driver,
    GoalRegister,
    Place,
    Standing,
    Waker,
    complaint,
    standing,
)
from adaptive_contact.bridge.health import SILENT_AFTER, Punctuality, ServoHealth, due, is_stale
from adaptive_contact.bridge.plan import JointPlan, LegPlan, PortPlan
from adaptive_contact.bridge.tables import Block, Register
from adaptive_contact.bridge.transport import Mailbox
from adaptive_contact.wire import ServoCounts, ServoSample

# Readings end this share of the period after the tick was due, also if servos are silent, so that
# goals and samples go out in time; a tick that began late has the other share at the least.
_END_SHARE, _LEAST_SHARE = 0.9, 0.4


@dataclasses.dataclass
class _Servo:
    """Holds what is known of a servo."""

    joint: JointPlan  # it is of
    waker: Waker  # says whether it may be moved
    steps: int | None = None  # position, as it was last read
    off_rad: float = 0.0  # from the position read to where it was at its moment of the tick
    speed_rad_s: float = 0.0
    goal: int | None = None  # in force, steps
    last_goal: int | None = None
    valid: bool = False
    fresh: bool = False  # it has answered in this tick
    stands: Standing | None = None  # how, as far as this tick's readings say
    # what its goal register held against what was written
    register: GoalRegister = "taken"
    shut_seen: bool = False
    punctual: Punctuality = dataclasses.field(default_factory=Punctuality)

    @property
    def angle(self) -> float | None:
        if self.steps is None:
            return None
        return self.joint.angle(self.steps) + self.joint.direction * self.off_rad


class Cycle:
    """Runs the control ticks of one port.

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
        self._servos = {
            joint.servo: _Servo(joint, Waker(joint, leg.max_step_rad))
            for leg in plan.legs
            for joint in leg.joints
        }
        self.health = {joint.servo: ServoHealth() for joint in plan.joints}
        # by leg; none where the port only observes
        self.drivers = {leg.id: Driver(leg) for leg in plan.legs} if mode == "drive" else {}
        self._lacking: dict[str, list[int]] = {}
        self._until_s = self._end_s = 0.0
        self._count = 0
        self._hurry_until = 0

    @property
    def holding(self) -> list[str]:
        """Return the legs whose commands have stopped."""
        return [leg for leg, driver in self.drivers.items() if driver.mode == "holding"]

    @property
    def lacking(self) -> dict[str, str]:
        """Notes on legs that have commands but not all their servos, by leg."""
        notes = {}
        for leg, servos in self._lacking.items():
            if servos:
                reasons: dict[str, list[str]] = {}
                for servo in servos:
                    reasons.setdefault(self._trouble(servo), []).append(str(servo))
                names = "; ".join(f"{', '.join(ids)} ({why})" for why, ids in reasons.items())
                begun = self.drivers[leg].goal is not None
                does = "goes on without" if begun else "commands wait for"
                notes[leg] = f"leg {leg}: {does} servo {names}"
        return notes

    @property
    def limited(self) -> int:
        """Count commands that limits or the largest step cut down."""
        return sum(driver.limited for driver in self.drivers.values())

    @property
    def counts(self) -> dict[str, ServoCounts]:
        """Counts of servos with faults, by id."""
        by_id = {str(servo): record.counts for servo, record in self.health.items()}
        return {servo: counts for servo, counts in by_id.items() if counts is not None}

    def restart(self) -> None:
        """Forget all positions and goals after an outage: servos may have moved, or lost goals.

        What was last known of them stays in the samples, marked invalid, so that a leg with a
        servo that does not come back is still there.
        """
        for servo in self._servos.values():
            servo.last_goal = None
            servo.speed_rad_s = 0.0
            servo.valid = servo.fresh = False
            servo.waker.forget()
        for record in self.health.values():
            # A servo that was silent is asked, and reported, as silent until it answers.
            record.misses = SILENT_AFTER - 1 if record.silent else 0
        for driver in self.drivers.values():
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
            A sample of every leg whose servos have all answered at least once.

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
        """Return the joint whose goal moved most from the tick before to the last, if one did."""
        best, largest = None, 0
        for servo in self._servos.values():
            if servo.goal is not None and servo.last_goal is not None and servo.valid:
                moved = abs(servo.goal - servo.last_goal)
                if moved > largest:
                    best, largest = servo.joint, moved
        return best

    def goal_of(self, joint: JointPlan) -> tuple[int | None, int | None]:
        """Return the goal of a joint at the last reading, and at the one before, steps."""
        servo = self._servos[joint.servo]
        return (servo.goal, servo.last_goal) if servo.valid else (None, None)

    def query_alarms(self, now_ns: int) -> None:
        """Query servos that complain: what is wrong, and whether they still drive; now and then.

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
        # What alarms are about is asked for this share of the period at most, after the tick's own
        # work.
        end_s = now_ns / 1e9 + 0.3 * self.plan.period_s
        asked = asked[first:] + asked[:first]
        states = {number: self._servos[number].joint.model.state for number in asked}
        readings = self._read_of(states, 0.0, end_s)
        for number, (reading, block) in readings.items():
            if reading.data is not None:
                servo = self._servos[number]
                stands = standing(servo.joint.model, block, reading.data, servo.waker.fatal)
                if stands.alarms:
                    self.health[number].alarm(stands.alarms)
                self._update_standing(servo, stands)

    # -- private -------------------------------------------------------------------------------

    def _read(self, now_ns: int, due_ns: int) -> None:

        asked = due(self.health, self._count, hurry=self._count < self._hurry_until)
        now_s, period_s = now_ns / 1e9, self.plan.period_s
        # A second try after a wrong checksum has to begin within this share of the control period.
        self._until_s = now_s + 0.4 * period_s
        self._end_s = max(due_ns / 1e9 + _END_SHARE * period_s, now_s + _LEAST_SHARE * period_s)
        drives = self.mode == "drive"
        models = {number: self._servos[number].joint.model for number in asked}
        blocks = {n: m.watched if drives else m.goal_and_motion for n, m in models.items()}
        readings = self._read_of(blocks, self._until_s, self._end_s)
        for number, servo in self._servos.items():
            servo.last_goal = servo.goal
            servo.fresh, servo.stands = False, None
            if number not in readings:  # not asked, or no time was left
                servo.valid = False
                continue
            reading, block = readings[number]
            was_silent = self.health[number].silent
            self.health[number].record_reading(reading)
            if was_silent and reading.data is not None:
                # Power has come back, it seems: ask the others at once.
                self._hurry_until = self._count + len(self._servos) + 1
            if self.health[number].silent:
                servo.waker.forget()  # unknown where it is, and which servo it will be
            servo.fresh = reading.data is not None
            servo.valid = servo.fresh and self._store_reading(servo, reading, block, due_ns)

    def _read_of(
        self, blocks: Mapping[int, Block], until_s: float, end_s: float
    ) -> dict[int, tuple[Reading, Block]]:
        """Read registers of servos, the same ones in one go: readings, and of what."""
        by_block: dict[Block, list[int]] = {}
        for number, block in blocks.items():
            by_block.setdefault(block, []).append(number)
        return {
            number: (reading, block)
            for block, numbers in by_block.items()
            for number, reading in self.bus.read(numbers, block, until_s, end_s).items()
        }

    def _store_reading(self, servo: _Servo, reading: Reading, block: Block, due_ns: int) -> bool:
        """Store a reading's values; False if the position is not one of this tick."""
        assert reading.data is not None
        model = servo.joint.model
        registers = model.registers
        faults = self.health[servo.joint.servo].faults
        steps = block.part(reading.data, registers["present_position"])
        speed = block.part(reading.data, registers["present_speed"]) * model.speed_rad_s
        servo.goal = block.part(reading.data, registers["goal_position"])
        if self.mode == "drive":
            servo.register = servo.waker.compare(servo.goal)
            if servo.register == "foreign":
                faults["foreign_goal"] += 1
            if model.compact:
                self._update_standing(
                    servo, standing(model, block, reading.data, servo.waker.fatal)
                )
        stale = servo.steps is not None and is_stale(
            steps, servo.steps, speed, servo.speed_rad_s, model.step_rad / self.plan.period_s
        )
        servo.steps, servo.speed_rad_s = steps, speed
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
        """Limit the newest commands and write them, to servos that may be moved."""
        for leg in self.plan.legs:
            self._forward_command(leg, self.drivers[leg.id])
        legs = [leg for leg in self.plan.legs if self.drivers[leg.id].is_asked(now_ns)]
        asked = [self._servos[joint.servo] for leg in legs for joint in leg.joints]
        fresh = [servo for servo in asked if servo.fresh]
        self._learn([servo for servo in fresh if servo.waker.wanted is not None])
        self._read_states([servo for servo in fresh if servo.waker.setting is not None])
        goals: dict[int, int] = {}
        here: dict[int, int] = {}
        on: dict[int, int] = {}
        for leg in self.plan.legs:
            driver = self.drivers[leg.id]
            servos = [self._servos[joint.servo] for joint in leg.joints]
            asked_now = leg in legs
            if not asked_now:
                for servo in servos:  # while nothing is commanded, others may change them
                    servo.waker.forget()
            places = [self._find_start(servo) if asked_now else None for servo in servos]
            start = [self._start(driver, j, *pair) for j, pair in
                     enumerate(zip(servos, places, strict=True))]  # fmt: skip
            before = driver.goal and list(driver.goal)
            absent = [j for j, servo in enumerate(servos) if self._is_absent(servo)]
            wanted = driver.step(start, now_ns, absent)
            self._lacking[leg.id] = [
                servo.joint.servo
                for servo, place in zip(servos, places, strict=True)
                if asked_now
                # For more than a tick.
                and (
                    self._is_absent(servo)
                    or servo.waker.trouble is not None
                    or (place is None and wanted is None)
                )
            ]
            if wanted is None or driver.goal is None:
                continue
            for j, (servo, place) in enumerate(zip(servos, places, strict=True)):
                number, waker = servo.joint.servo, servo.waker
                if place is None:
                    # Not read in this tick, or not to be moved: its goal waits where it is.
                    driver.goal[j] = driver.goal[j] if before is None else before[j]
                elif place.torque:
                    waker.awake = True
                    servo.goal = goals[number] = waker.step(place, wanted[j])
                elif place.at_goal:
                    on[number] = 1
                else:
                    servo.goal = here[number] = waker.wrote(place.steps)
        # Sync writes are not answered: each is seen in the next tick's reading, or written again.
        self._sync_write("goal_position", here | goals)
        self._sync_write("torque_enable", on)

    def _sync_write(self, name: str, values: Mapping[int, int]) -> None:
        """Write a register of servos, with one sync write for each place that it has in them."""
        places: dict[Register, dict[int, int]] = {}
        for number, value in values.items():
            register = self._servos[number].joint.model.registers[name]
            places.setdefault(register, {})[number] = value
        for register, some in places.items():
            self.bus.sync_write(register, some)

    def _find_start(self, servo: _Servo) -> Place | None:
        """Find the place from which a servo can be moved in this tick; None without one."""
        if not servo.fresh or servo.steps is None or servo.goal is None:
            return None
        return servo.waker.find_start(servo.stands, servo.steps, servo.goal)

    def _start(self, driver: Driver, j: int, servo: _Servo, place: Place | None) -> float | None:
        """Return the angle from which a joint is moved; corrects the driver if it is another."""
        if place is None:
            return None
        at = servo.joint.angle(place.steps)
        driver.bounds[j] = servo.waker.bounds()
        ours = servo.waker.awake and servo.register != "foreign"
        if not ours:
            driver.found(j, at)
        elif driver.goal is not None and servo.joint.steps(driver.goal[j]) != place.steps:
            driver.goal[j] = at  # what was written last is not what is in force
        return at

    def _learn(self, servos: Sequence[_Servo]) -> None:
        """Read how servos are set, before their first goal; a few at a time, they are long."""
        # Settings of servos that are to be woken are read within this share of the period.
        left_s = 0.25 * self.plan.period_s
        some: dict[int, Block] = {}
        for servo in servos:
            block = servo.waker.wanted
            assert block is not None
            left_s -= self.bus.cost_s(block)
            if left_s < 0.0 and some:
                break
            some[servo.joint.servo] = block
        for number, (reading, _) in self._read_of(some, 0.0, self._end_s).items():
            if reading.data is not None:
                self._servos[number].waker.learn(reading.data)

    def _read_states(self, servos: Sequence[_Servo]) -> None:
        """Read the servos' state where the tick's reading does not have it (X-series).

        Those that are awake take turns; the others, and those whose goal is not the one written,
        are read in every tick.
        """
        servos = [servo for servo in servos if not servo.joint.model.compact]
        awake = [s for s in servos if s.waker.awake and s.register == "taken"]
        turn = awake[self._count % len(awake)] if awake else None
        asked = {}
        for servo in servos:
            if servo in awake and servo is not turn:
                servo.stands = Standing(torque=True)
            else:
                asked[servo.joint.servo] = servo.joint.model.state
        readings = self._read_of(asked, self._until_s, self._end_s)
        for number, (reading, block) in readings.items():
            servo = self._servos[number]
            if reading.data is not None:
                self._update_standing(servo, standing(servo.joint.model, block, reading.data))

    def _is_absent(self, servo: _Servo) -> bool:
        record = self.health[servo.joint.servo]
        return record.silent or record.shut

    def _trouble(self, number: int) -> str:
        record = self.health[number]
        if record.silent:
            return "no answer"
        if record.shut:
            return "shut down"
        return self._servos[number].waker.trouble or "not read yet"

    def _update_standing(self, servo: _Servo, stands: Standing) -> None:
        """Update how a servo stands; one that has shut itself down gets no goals.

        It is said to be shut down where two readings in a row say so.
        """
        record = self.health[servo.joint.servo]
        servo.stands = stands
        record.shut, servo.shut_seen = stands.shut and servo.shut_seen, stands.shut
        if stands.shut:
            servo.waker.forget()

    def _forward_command(self, leg: LegPlan, driver: Driver) -> None:
        taken = self._mailbox.pop_command(leg.id)
        if taken is None:
            return
        command, arrival_ns = taken
        wrong = complaint(command, len(leg.joints))
        if wrong is not None:
            self._mailbox.refuse(f"leg '{leg.id}': {wrong}")
            return
        driver.receive(command, arrival_ns)

    def _sample(self, leg: LegPlan, t_ns: int, seq: int) -> ServoSample | None:
        servos = [self._servos[joint.servo] for joint in leg.joints]
        measured, desired = [], []
        for servo in servos:
            if servo.angle is None or servo.goal is None:
                return None
            measured.append(servo.angle)
            desired.append(servo.joint.angle(servo.goal))
        valid = [servo.valid for servo in servos]
        driver = self.drivers.get(leg.id)
        return ServoSample(
            t_ns=t_ns,
            seq=seq,
            measured=measured,
            desired=desired,
            preview=None if driver is None else driver.preview,
            valid=None if all(valid) else valid,
            run=self._run,
        )
