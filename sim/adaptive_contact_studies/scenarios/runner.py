"""Making what is missing: recordings and replays, several at a time, resumable.

A job is one recording with all the replays that want it.  Each is a pure function of its settings
and writes its files whole, so that an interrupted run goes on where it stopped and ends with the
same numbers, however many processes there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple
from zipfile import is_zipfile

from adaptive_contact.errors import ConfigurationError, SimulationDivergedError
from adaptive_contact_studies.scenarios.recording import file_of, key_of, made
from adaptive_contact_studies.scenarios.replay import (
    load_replay,
    replay,
    replay_file,
    save_replay,
)
from adaptive_contact_studies.scenarios.spec import RecordingSpec, ReplaySpec, Scenario
from adaptive_contact_studies.workers import completed

# The form that is published, and how the figures of a form are called.
FULL: Final = "full"
RESULTS: Final = "results-{form}.json"


class Folders(NamedTuple):
    """Where things are kept."""

    # recordings, replays: files named by hashes
    recordings: Path
    replays: Path
    pages: Path  # pictures of one form
    results: Path  # its figures

    @classmethod
    def of(cls, out: Path, form: str = FULL) -> Folders:
        """The places below a folder, made if need be.

        Recordings and replays are named by what is in them, and shared; figures and pictures are
        those of one form, so that a quick look never stands in for the whole.

        Raises:
            ConfigurationError: they cannot be made.
        """
        pages = out / f"pages-{form}"
        folders = cls(out / "recordings", out / "replays", pages, out / RESULTS.format(form=form))
        try:
            for folder in folders[:3]:
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"{out}: cannot be made ({error.strerror}); give another folder with --out"
            ) from error
        return folders


class Job(NamedTuple):
    """One recording, and the replays of it that are missing."""

    recording: RecordingSpec
    replays: tuple[ReplaySpec, ...]

    @property
    def work(self) -> float:
        """How long it takes, roughly: simulated seconds, and those that learners go through."""
        learners = sum(len(spec.variants) for spec in self.replays) * len(self.recording.legs)
        return self.recording.seconds * (1.0 + _LEARNER_SHARE * learners)


class Done(NamedTuple):
    """A job that ended; ``problem`` says why without replays."""

    job: Job
    problem: str | None


# A learner's second against a simulated one.
_LEARNER_SHARE: Final = 0.06


def jobs(chosen: Iterable[Scenario], folders: Folders) -> list[Job]:
    """What is missing of some scenarios: the first run of each, then the second, and so on.

    So there is something to judge of all of them soon; within a round the longest comes first.
    """
    wanted: dict[str, dict[str, ReplaySpec]] = {}
    rounds: dict[str, int] = {}
    for scenario in chosen:
        for specs in (scenario.replays, scenario.references):
            for i, spec in enumerate(specs):
                key = key_of(spec.recording)
                wanted.setdefault(key, {})[replay_file(spec, folders.replays).name] = spec
                rounds[key] = min(i, rounds.get(key, i))
    missing: list[tuple[int, Job]] = []
    for key, group in wanted.items():
        recording = next(iter(group.values())).recording
        lacking = tuple(s for n, s in group.items() if not is_zipfile(folders.replays / n))
        # Judging needs the recording's truth, too.
        if lacking or not is_zipfile(file_of(recording, folders.recordings)):
            missing.append((rounds[key], Job(recording, lacking)))
    return [job for _, job in sorted(missing, key=lambda entry: (entry[0], -entry[1].work))]


def run(
    work: Sequence[Job],
    folders: Folders,
    *,
    processes: int = 2,
    progress: Callable[[Done], None] = lambda _: None,
) -> list[str]:
    """Do jobs.

    Returns:
        Why some have no replays, one line each.

    Raises:
        ConfigurationError: a file cannot be written.
        KeyboardInterrupt: interrupted; what was done is kept.
    """
    problems: list[str] = []
    try:
        for _, done in completed(partial(_do, folders), work, processes):
            if done.problem:
                problems.append(done.problem)
            progress(done)
    except BrokenProcessPool as error:
        raise ConfigurationError(
            "a process ended that was at work (out of memory?); run the same command again to go "
            "on, with fewer --processes"
        ) from error
    return sorted(problems)


def _do(folders: Folders, job: Job) -> Done:
    try:
        recording = made(job.recording, folders.recordings)
    except SimulationDivergedError as error:
        seed = job.recording.settings.seed
        return Done(job, f"the run with seed {seed} has no recording: {error}")
    for spec in job.replays:
        path = replay_file(spec, folders.replays)
        if load_replay(spec, path) is None:
            save_replay(replay(spec, recording), path)
    return Done(job, None)
