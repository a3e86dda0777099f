"""Where state is kept, and what it belongs to."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Final

import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Robot
from adaptive_contact.service.state.format import FORMAT

__all__ = ["default_folder", "settings_digest"]

_DIGEST_HEX: Final = 16
# Formats of the file and of what the learner puts into it that a digest does not name.  Any later
# one is part of it: a version with another format has files of its own, and a step back finds what
# the version before has left.
_UNNAMED: Final = (2, 3)


def default_folder() -> Path:
    """The user's own folder: ``$XDG_STATE_HOME/adaptive-contact``, or below ``~/.local/state``.

    Raises:
        ConfigurationError: the user has no home.
    """
    base = os.environ.get("XDG_STATE_HOME", "")
    # The specification says to ignore a relative path.
    if Path(base).is_absolute():
        return Path(base) / "adaptive-contact"
    try:
        return Path.home() / ".local" / "state" / "adaptive-contact"
    except RuntimeError as error:  # a container's user, say, with neither HOME nor an account
        raise ConfigurationError(
            "no home folder to keep state in ($HOME is not set); give --state DIR, or --no-state"
        ) from error


def settings_digest(
    robot: Robot,
    leg: str,
    baseline: str = "",
    *,
    formats: tuple[int, int] = (FORMAT, _UNNAMED[1]),
) -> str:
    """Digest of everything that makes what a leg has learned useless when it changes.

    Args:
        robot: description; mounts, servo ids and the aim for false alarms do not enter.
        leg: id; one that the description lacks is known by its id alone.
        baseline: text of the models the learner starts from, empty for none: a new baseline is
            a new beginning, which old state must not undo.
        formats: of the file, and of the learner's snapshot in it.

    Returns:
        16 hexadecimal digits.
    """
    shape: tuple[object, ...] = ()
    if leg in robot.leg_ids:
        known = robot.leg(leg)
        shape = (known.joints, known.joint_axes, known.lengths_m, robot.quantum(leg))
        if known.origins_m is not None:
            shape += (known.origins_m,)
    facts: tuple[object, ...] = (robot.period_s, robot.servo, leg, shape, baseline)
    if formats != _UNNAMED:
        facts += (formats,)
    return hashlib.sha256(msgspec.json.encode(facts)).hexdigest()[:_DIGEST_HEX]
