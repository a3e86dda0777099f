r"""Runs a port's process: ticks on an even grid, outages survived, status once a second.

Reading right after another controller's writes.

In observe mode another controller writes goals at the control rate, at times of its own.  A sample
pairs positions with the goals in force until the next reading, so the reading has to come right
*after* the writes: before them, the goals it sees would be those of the tick that just ended.

Once a tick, one moving servo's goal is read a *lead* ahead of the main reading.  A goal that
changes between the two was written in between:

- no change: the writes came earlier; the schedule moves earlier, by half a lead until it meets them
  (at the latest after one turn), by a twelfth once it has;
- change: it moves later by a twelfth, so that it stays a lead behind the writes.

Goals that stand still show nothing, and the schedule stays.
"""

from __future__ import annotations

import dataclasses
import gc
import threading
import time
from typing import Final, Literal

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.cycle import Cycle
from adaptive_contact.bridge.health import Conditions, News
from adaptive_contact.bridge.plan import JointPlan, PortPlan
from adaptive_contact.bridge.port import PortLostError
from adaptive_contact.bridge.transport import Mailbox, Outlet, Pulse
from adaptive_contact.errors import BusError
from adaptive_contact.wire import NS_PER_S, BridgeStatus

# Of the control period: 2.4 ms at 50 Hz.
LEAD_SHARE: Final = 0.12


@dataclasses.dataclass
class PhaseLock:
    """Estimates when another program's writes come, relative to our reading."""

    period_s: float
    locked: bool = False  # the writes come right before the reading, as far as could be seen
    _unconfirmed: int = 0

    @property
    def lead_s(self) -> float:
        """Return how far ahead of the main reading the goal is to be read, s."""
        return LEAD_SHARE * self.period_s

    def update(self, *, before: int | None, now: int | None, last: int | None) -> float:
        """Take in one tick's goals of one servo, in steps; None for a reading that did not come.

        Args:
            before: read :attr:`lead_s` ahead of the main reading.
            now: read with it.
            last: read with the main reading a tick ago.

        Returns:
            Seconds to move the schedule by; below zero for earlier.
        """
        if before is None or now is None or last is None or now == last:
            return 0.0
        if before != now:
            self.locked, self._unconfirmed = True, 0
            return self.lead_s / 12
        if not self.locked:
            return -self.lead_s / 2
        self._unconfirmed += 1
        # Readings with moving goals, in a row, after which a lock that is not confirmed is
        # given up.
        if self._unconfirmed >= 8:
            self.locked, self._unconfirmed = False, 0
        return -self.lead_s / 12


class PortLoop:
    """Runs one port until it is stopped.

    Args:
        run: the ``run`` of the samples, new at each start.
        phase: where in the control period of the monotonic clock ticks begin, 0 to 1; ports that
            take turns do not wait for each other's processor.  An observer finds its own.
    """

    def __init__(
        self,
        plan: PortPlan,
        mode: Literal["observe", "drive"],
        outlet: Outlet,
        mailbox: Mailbox,
        run: int,
        *,
        phase: float = 0.0,
    ) -> None:
        self.plan = plan
        self.mode = mode
        self.bus = Bus(plan.name, plan.port)
        self.cycle = Cycle(plan, self.bus, mode, mailbox, run)
        self._outlet = outlet
        self._mailbox = mailbox
        self._pulse = Pulse(plan.period_s)
        self._news = News(plan)
        self._lock = PhaseLock(plan.period_s) if mode == "observe" else None
        self._period_ns = round(plan.period_s * NS_PER_S)
        self._phase_ns = round(phase * self._period_ns)
        self._reconnects = 0
        self._lost = False
        self._returning = False
        self._held, self._lacking = Conditions[str](), Conditions[str]()
        self._status_ns = 0
        self._watched: JointPlan | None = None

    def run(self, stop: threading.Event) -> None:
        """Make ticks until ``stop`` is set; outages of the port are waited out.

        Raises:
            BusError: the port cannot be opened at the start.
        """
        self.bus.open()
        # What exists now stays; the collector need not go through it in the middle of a tick.
        gc.collect()
        gc.freeze()
        try:
            self._run(stop)
        finally:
            self.bus.close()

    # -- private -------------------------------------------------------------------------------

    def _run(self, stop: threading.Event) -> None:
        mono_ns = time.monotonic_ns()
        wall_ns = time.time_ns() - mono_ns
        turns = (mono_ns - self._phase_ns) // self._period_ns
        due_ns, seq = (turns + 2) * self._period_ns + self._phase_ns, 0
        self._status_ns = mono_ns + NS_PER_S
        while not stop.is_set():
            if self._lost and not self._reopen(stop):
                continue
            begun_ns, before = self._wait(due_ns, stop)
            if stop.is_set():
                return
            late = (begun_ns - due_ns) // self._period_ns
            if late > 0:
                # Ticks of an outage are no failing of the cycle.
                self._pulse.counts["missed"] += 0 if self._returning else late
                due_ns += late * self._period_ns
                seq += late
            try:
                samples = self.cycle.tick(wall_ns + due_ns, seq, begun_ns, due_ns)
                self._outlet.samples(samples)
                self._returning = False
                self._pulse.beat(begun_ns, time.monotonic_ns())
                due_ns += self._period_ns + self._shift(before)
                seq += 1
                self._tell_holding()
                self._tell(begun_ns)
            except PortLostError as error:
                self._lost = True
                self._outlet.print_line(f"{error}; trying to open it again")

    def _wait(self, due_ns: int, stop: threading.Event) -> tuple[int, int | None]:
        """Wait for the tick; an observer reads one goal a little ahead of it.

        Returns:
            Monotonic time, and the goal read ahead in steps.
        """
        before = None
        joint = self.cycle.moving_goal() if self._lock is not None else None
        if self._lock is not None and joint is not None:
            lead_ns = round(self._lock.lead_s * NS_PER_S)
            stop.wait(max(due_ns - lead_ns - time.monotonic_ns(), 0) / NS_PER_S)
            # Late already: the main reading comes first.
            if time.monotonic_ns() < due_ns - lead_ns // 2:
                before = self._goal(joint)
        stop.wait(max(due_ns - time.monotonic_ns(), 0) / NS_PER_S)
        self._watched = joint
        return time.monotonic_ns(), before

    def _goal(self, joint: JointPlan) -> int | None:
        register = joint.model.registers["goal_position"]
        try:
            data = self.bus.read([joint.servo], register.block)[joint.servo].data
        except PortLostError:
            return None  # the main reading will show it
        return None if data is None else register.value(data)

    def _shift(self, before: int | None) -> int:
        """Return the time by which the next tick is moved, in observe mode, ns."""
        if self._lock is None or self._watched is None:
            return 0
        now, last = self.cycle.goal_of(self._watched)
        return round(self._lock.update(before=before, now=now, last=last) * NS_PER_S)

    def _reopen(self, stop: threading.Event) -> bool:
        """Try to open a lost port; True when it is back."""
        try:
            self.bus.open()
        except BusError:
            self._tell(time.monotonic_ns())
            # A lost port is tried this often; a cable put back is found within two seconds with
            # room to spare.
            stop.wait(0.25)
            return False
        self._lost, self._returning = False, True
        self._reconnects += 1
        self._pulse.forget()
        self.cycle.restart()
        self._outlet.print_line(f"port {self.plan.name}: {self.bus.device} is back")
        return True

    def _tell_holding(self) -> None:
        new, back = self._held.update(set(self.cycle.holding))
        if new:
            legs = ", ".join(new)
            self._outlet.print_line(f"leg {legs}: no command for 200 ms, holding the last goal")
        if back:
            self._outlet.print_line(f"leg {', '.join(back)}: commands are back")

    def _tell(self, now_ns: int) -> None:
        """Publish the status where a second has passed."""
        if now_ns < self._status_ns:
            return
        self._status_ns = now_ns + NS_PER_S
        if not self._lost:
            self.cycle.query_alarms(time.monotonic_ns())
            for line in self._news.lines(self.cycle.health, self.bus.late):
                self._outlet.print_line(line)
            # Legs that have commands which some of their servos do not follow.
            for line in self._lacking.update(set(self.cycle.lacking.values()))[0]:
                self._outlet.print_line(f"port {self.plan.name}: {line}")
        self._outlet.status(self.status(now_ns))

    def status(self, now_ns: int) -> BridgeStatus:
        """Return the state of the port."""
        holding = self.cycle.holding
        note = "; ".join(self.cycle.lacking.values()) or self._mailbox.last_reject
        if self._lock is not None and self.cycle.moving_goal() and not self._lock.locked:
            note = "looking for the moment at which the other controller writes its goals"
        return BridgeStatus(
            port=self.plan.name,
            t_ns=time.time_ns(),
            mode=self.mode,
            state="lost" if self._lost else "holding" if holding else "running",
            rate_hz=0.0 if self._lost else self._pulse.rate_hz(now_ns),
            wanted_hz=1.0 / self.plan.period_s,
            cycle_ms=self._pulse.cycle_ms,
            jitter_ms=self._pulse.jitter_ms,
            cycles=self._pulse.counts["cycles"],
            missed=self._pulse.counts["missed"],
            reconnects=self._reconnects,
            commands_refused=self._mailbox.rejected,
            commands_limited=self.cycle.limited,
            holding=holding,
            servos=self.cycle.counts,
            note=note,
        )
