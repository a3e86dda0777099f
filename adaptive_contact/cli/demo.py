"""Defines ``adaptive-contact demo``: service and simulator for a minute, with a report.

``serve`` and ``sim walk`` run as processes of their own; half way through, one leg of the robot
drifts.  What was recorded is then judged by the rules of ``score``, drawn as ``replay --plot``
draws it, and replayed by the model as it was at the start.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from adaptive_contact.cli._options import (
    ForceOption,
    flatten,
    option,
    refuse_to_replace,
    seconds_option,
)
from adaptive_contact.cli._output import print_line, print_note
from adaptive_contact.cli._signals import on_signals
from adaptive_contact.cli._sim_options import needs_simulator
from adaptive_contact.cli._web import WEB_PANEL, Page, live_page
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact.robot import Robot

if TYPE_CHECKING:
    from adaptive_contact.score import Score, Summary
    from adaptive_contact.web import LivePage
    from adaptive_contact_sim.robots import SimulatedRobot


_OUT: Final = Path("out/demo")
_MADE: Final = ("demo.mcap", "summary.json", "report.html")
_DRIFTS: Final = (("friction", 4.0), ("mass", 0.06))
_DRIFT_WORDS: Final = "friction × 4 and 60 g of mud"
# `serve` ends within 2 s of a signal, within 7 s on a slow disk; the simulator after its tick.
_END_S: Final = 10.0


@flatten
def demo(
    *,
    out: Annotated[Path, option("--out", "Where report and figures go.", "FOLDER")] = _OUT,
    # Swings take 1.3 s a leg: fewer leave too few of them on either side of the drift.
    seconds: Annotated[
        float,
        seconds_option("--seconds", "How long to walk, in real time.", least=8.0, most=3600.0),
    ] = 60.0,
    seed: Annotated[int, option("--seed", "Seed of the walk.", min=0)] = 0,
    robot: Annotated[
        str, option("--robot", "Robot that walks: hexapod, quadruped12.", "NAME")
    ] = "hexapod",
    web: Annotated[
        bool, option("--web", "Show it as a page in the browser, too.", panel=WEB_PANEL)
    ] = False,
    force: ForceOption = False,
    page: Page,
) -> None:
    """Watch a simulated robot walk, one leg drift, and what becomes of its contacts.

    Starts `serve` and `sim walk` as processes, and writes a page, the figures and the
    recording.  Those in out/demo are replaced; in another folder only with --force.
    """
    stop = threading.Event()
    on_signals(lambda *_: _on_signal(stop))
    with needs_simulator():
        from adaptive_contact_sim.robots import simulated_robot

    walker = simulated_robot(robot)
    if walker.walk is None:
        raise ConfigurationError(
            f"robot '{robot}' ({walker.about}) does not walk; expected hexapod or quadruped12"
        )
    refuse_to_replace([out / name for name in _MADE], "--out", force=force or out == _OUT)
    page_settings = page.settings(web)
    run = _Demo(out, seconds, seed, walker, stop)
    try:
        with ExitStack() as stack:
            live = None
            if page_settings is not None:
                live = stack.enter_context(live_page(page_settings, browse=not page.no_browser))
                live.waits_for(
                    "service and simulator are starting",
                    "The first start on a computer compiles the arithmetic, up to a minute.",
                    "note",
                )
            run.conduct(live)
            run.evaluate()
            if live is not None:
                live.close(f"The demo is over; {out / 'report.html'} has what was found.")
    except (KeyboardInterrupt, AdaptiveContactError):
        # Ctrl-C in a terminal reaches every process at once; who ends first is chance.
        if not stop.is_set():
            raise
        print_note("stopped; nothing was judged")
        # What a shell calls "ended by Ctrl-C".
        raise typer.Exit(130) from None


def _on_signal(stop: threading.Event) -> None:
    """The first signal asks for an orderly end; the second breaks in, and still ends the others."""
    if stop.is_set():
        raise KeyboardInterrupt
    stop.set()


class _Demo:
    """Runs the demo.

    Args:
        out: folder of what it writes; made where it is not there.
        seconds: of walking, in real time.
        seed: of the walk.
        walker: the robot that walks.
        stop: ends it early when set.
    """

    def __init__(
        self, out: Path, seconds: float, seed: int, walker: SimulatedRobot, stop: threading.Event
    ) -> None:
        self._recording, self._summary, self._report = (out / name for name in _MADE)
        self._seconds, self._seed, self._walker, self._stop = seconds, seed, walker, stop
        self._leg = "rf" if "rf" in walker.layout.legs else "fr"
        # A little before half time: what comes after the drift is what the demo is about.
        self._drift_s = round(0.42 * seconds, 1)
        try:
            out.mkdir(parents=True, exist_ok=True)
            for name in _MADE:
                (out / name).unlink(missing_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{out}: cannot be used ({error.strerror}); give --out a folder that can be written"
            ) from error

    def conduct(self, page: LivePage | None) -> None:
        """Run the processes to the end of the walk, and record it.

        Raises:
            AdaptiveContactError: one failed, after its own last line; or it was stopped.
        """
        from adaptive_contact.cli._compiling import compile_tick
        from adaptive_contact.service.link import Link, client_settings
        from adaptive_contact.service.recording import RecordingWriter
        from adaptive_contact.service.recording.recorder import Recorder
        from adaptive_contact.service.watch import Feed

        # Here and not in the service, which would compile before it listens.
        compile_tick(self._stop)
        name, listen = self._walker.name, ("--listen", "tcp/127.0.0.1:0", "--log-level", "warning")
        with ExitStack() as stack:
            # Without state: a demo begins with the shipped models, and leaves none of its own.
            serve = ("serve", "--config", name, "--no-state", *listen)
            service = stack.enter_context(_Child("the service", serve))
            endpoint = service.first_line().partition("listening on ")[2].partition(";")[0]
            print_line(f"service     process {service.pid}, listening on {endpoint}")
            settings = client_settings([endpoint], wait=False)
            link = stack.enter_context(Link.open(settings))
            feed = Feed(link)
            if page is not None:
                page.show_service(stack.enter_context(Link.open(settings)))
                stack.callback(page.leave)
            about = {"robot": self._walker.description.name}
            writer = stack.enter_context(RecordingWriter(self._recording, about))
            recorder = Recorder(link, writer, "robot/**")
            drifts = [
                ("--drift", f"{kind}:leg={self._leg},value={value:g}@{self._drift_s}s")
                for kind, value in _DRIFTS
            ]
            walk = (
                *("sim", "walk", "--robot", name, "--terrain", "rough", "--stop-on", "truth"),
                *("--seconds", f"{self._seconds:g}", "--seed", str(self._seed)),
                *itertools.chain(*drifts),
                *("--connect", endpoint),
            )
            simulator = stack.enter_context(_Child("the simulator", walk))
            simulator.first_line()
            print_line(f"simulator   process {simulator.pid}, seed {self._seed}")
            began_s, over = time.monotonic(), threading.Event()
            ended, next_s = False, 0.0

            def check_progress() -> None:  # twice a second
                nonlocal ended, next_s
                if service.poll() is not None:
                    raise service.failure()
                # What is on its way when the walk ends is written until the next check.
                if ended or self._stop.is_set():
                    over.set()
                ended = simulator.poll() is not None
                walked_s = time.monotonic() - began_s
                if walked_s >= next_s:
                    next_s += 5.0
                    legs = feed.view(time.monotonic_ns()).legs
                    found_of = (f"{leg.leg} {leg.seen or 0}/{leg.touches or 0}" for leg in legs)
                    when = "since" if walked_s >= self._drift_s else "at"
                    said = (
                        f"{walked_s:4.0f} of {self._seconds:.0f} s   leg {self._leg}: "
                        f"{_DRIFT_WORDS} {when} {self._drift_s:.0f} s"
                    )
                    print_line("  ".join((said, *found_of)))

            check_progress()
            recorder.run(over, on_progress=check_progress)
            if self._stop.is_set():
                raise AdaptiveContactError("stopped")
            if simulator.wait():
                raise simulator.failure()

    def evaluate(self) -> None:
        """Score, replay and draw the recording."""
        import msgspec

        from adaptive_contact.cli._replay_plot import write_plot
        from adaptive_contact.core.learn.mode import LearnerMode
        from adaptive_contact.score.tables import as_json

        robot = self._walker.description
        followed, _ = self._replayed(robot, LearnerMode.FULL)
        frozen, events = self._replayed(robot, LearnerMode.FROZEN)
        before = self._score(robot, to_s=self._drift_s)
        after = self._score(robot, from_s=self._drift_s)
        old = self._score(robot, events, from_s=self._drift_s)
        lines = (
            f"Before the drift: {_tally(before.total)}.",
            f"After it ({_DRIFT_WORDS} on leg {self._leg}): {_tally(after.total)}; "
            f"{self._leg} alone: {_tally(after.legs[self._leg])}.",
            f"The model of the start, frozen: {_tally(old.total)}; "
            f"{self._leg} alone: {_tally(old.legs[self._leg])}.",
        )
        drift = {"leg": self._leg, "at_s": self._drift_s, "values": dict(_DRIFTS)}
        tree: dict[str, Any] = {
            "v": 2,
            "result": lines,
            "robot": robot.name,
            "seconds": self._seconds,
            "seed": self._seed,
            "drift": drift,
            "before": as_json(before),
            "after": as_json(after),
            "frozen_after": as_json(old),
        }
        write_file(self._summary, msgspec.json.format(msgspec.json.encode(tree), indent=2) + b"\n")
        own = next(trace for trace in frozen if trace.leg == self._leg)
        traces = [*followed, dataclasses.replace(own, leg=f"{self._leg}\nfrozen")]
        write_plot(self._report, traces, "\n".join(lines), mark_s=self._drift_s)
        for line in (*lines, f"wrote {self._report}, {_MADE[1]} and {_MADE[0]}"):
            print_line(line)

    def _score(self, robot: Robot, events: Any = None, **within: float) -> Score:
        from adaptive_contact.score import score_messages
        from adaptive_contact.service.recording import read_recording

        return score_messages(read_recording(self._recording), robot, events, **within)

    def _replayed(self, robot: Robot, mode: Any) -> tuple[Any, Any]:
        """Return the traces of every leg, and events."""
        from adaptive_contact.core.bank import LearnerBank
        from adaptive_contact.model import shipped_baseline
        from adaptive_contact.service.recording import read_recording
        from adaptive_contact.service.replay import Counts, TraceBank, replay_events

        bank = TraceBank(LearnerBank(robot, shipped_baseline(robot.name), mode=mode))
        records = bank.gather(read_recording(self._recording))
        events = list(replay_events(records, bank, Counts()))
        return bank.traces(), events


class _Child(subprocess.Popen[str]):
    """Runs a command of this project; a context manager that ends it.

    What it says on standard error goes there.
    """

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        super().__init__(
            [sys.executable, "-m", "adaptive_contact", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )
        self._name = name

    def first_line(self) -> str:
        """Wait for the line by which it says that it runs.

        Raises:
            AdaptiveContactError: it ended before.
        """
        assert self.stdout is not None
        line = self.stdout.readline()
        if not line:
            raise self.failure()
        return line

    def failure(self) -> AdaptiveContactError:
        """Return that it has ended, in one line."""
        code = self.wait()
        return AdaptiveContactError(
            f"{self._name} ended too early (exit code {code}); what it said is above"
        )

    def __exit__(self, *raised: Any) -> None:
        self.terminate()
        try:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.wait(_END_S)
        finally:  # also when a second Ctrl-C breaks into the waiting: nothing may stay behind
            self.kill()
            super().__exit__(*raised)


def _tally(summary: Summary) -> str:
    counted, false = summary.counted, summary.false_alarms
    return f"{counted.found} of {counted.touches} touches found, {false} false"
