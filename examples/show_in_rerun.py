"""Show a recording in rerun: angles, contacts and truth of every leg, to scroll through.

    pip install rerun-sdk
    python examples/show_in_rerun.py walk.mcap [--save walk.rrd]

For the raw messages no script is needed: `adaptive-contact export walk.mcap --to protobuf -o OUT`,
then `rerun OUT`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ContactEvent, ContactTruth, Rejected, ServoSample, decode

KINDS = {"servo": ServoSample, "contact": ContactEvent, "truth": ContactTruth}


def main() -> int:
    """Show the recording of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--save", type=Path, help="write an .rrd file instead of opening a window")
    given = parser.parse_args()
    try:
        show(given.recording, given.save)
    except ModuleNotFoundError as error:
        print(f"show_in_rerun: {error}; run: pip install rerun-sdk", file=sys.stderr)
        return 2
    except AdaptiveContactError as error:
        print(f"show_in_rerun: {error}", file=sys.stderr)
        return 2
    return 0


def show(recording: Path, save: Path | None) -> None:
    """Send every message to rerun, at the time of its source's clock."""
    import rerun

    rerun.init("adaptive_contact", spawn=save is None)
    if save is not None:
        rerun.save(save)
    for record in read_recording(recording):
        head, _, word = record.key.rpartition("/")
        if word not in KINDS or not head.startswith("robot/leg/"):
            continue
        message = decode(record.payload, KINDS[word], record.encoding)
        if isinstance(message, Rejected):
            continue
        leg = head.removeprefix("robot/leg/")
        rerun.set_time("source", duration=message.t_ns / 1e9)
        if isinstance(message, ServoSample):
            rerun.log(f"{leg}/measured", rerun.Scalars(message.measured))
            rerun.log(f"{leg}/desired", rerun.Scalars(message.desired))
        else:
            rerun.log(f"{leg}/{word}", rerun.Scalars(float(message.contact)))


if __name__ == "__main__":
    sys.exit(main())
