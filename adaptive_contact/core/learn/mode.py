"""Names what a learner may do to follow its leg, and to report of one that is ambiguous."""

from __future__ import annotations

import enum


class LearnerMode(enum.StrEnum):
    """Selects whether a learner follows its leg; a frozen one is there for comparison."""

    FROZEN = "frozen"
    FULL = "full"


class WhenAmbiguous(enum.StrEnum):
    """Selects which contacts of a leg are reported while it is ``ambiguous`` (decision 24).

    WITHHOLD reports none where the readings do not follow the leg, or something holds its foot, and
    releases one that stands.  It reports those of a leg that only fits its model badly
    (``unsettled``), whose threshold is as wide as its lifts are far, and of a foot that counts as
    held in a swing that fits in its lift or before the contact.  STRICT withholds these, too.
    PUBLISH withholds none.
    """

    WITHHOLD = "withhold"
    STRICT = "strict"
    PUBLISH = "publish"
