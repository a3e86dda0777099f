"""Reads a recording as that of one robot, and names what is wrong with it.

Keys may stand under a namespace, or begin with ``/`` as topics of ROS do: a recording has neither
Zenoh's setting nor a person who would try another.  What is misspelt is named, not guessed; why
samples cannot be used is found as ``doctor`` finds it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from typing import Final

from adaptive_contact.checks.findings import EXPLAINS, Fault, entries, name_legs
from adaptive_contact.checks.legcheck import check_leg
from adaptive_contact.robot import Robot
from adaptive_contact.service.recording import Record
from adaptive_contact.status import LegFacts
from adaptive_contact.wire import Rejected, ServoSample, decode, leg_of_key, meant_key, namespace_of

# Most samples and refusals of each leg that are examined.
_KEPT: Final = 1000
_SHOWN: Final = 3

# Certain faults of what was sent, not of how the robot moves: those for which samples are refused,
# and readings that are not those of their joints.
_NAMED: Final = frozenset(
    {"unreadable", "time_type", "time_unit", "time_backwards", "joints"}
    | {"not_finite", "units", "period", "seq", "order", "limits"}
    | {"turn"}
)
# Of these, the ones that leave no tick to judge an event by.
_SPOILS: Final = frozenset({"units", "time_unit", "time_type", "time_backwards"})


class OneRobot:
    """Reads records once and yields them with the keys of the contract."""

    def __init__(self, records: Iterable[Record]) -> None:
        # that of the first leg's key; messages under others are left out and counted
        self.namespace: str | None = None
        self._records = records
        self._keys: dict[str, str | None] = {}
        self._others: Counter[str] = Counter()
        self._strays: Counter[str] = Counter()
        self._samples: dict[str, list[ServoSample]] = {}
        self._refused: dict[str, list[Rejected]] = {}
        self._faults: list[tuple[str, Fault]] | None = None

    def __iter__(self) -> Iterator[Record]:
        for record in self._records:
            if record.key in self._keys:
                key = self._keys[record.key]
            else:
                key = self._keys[record.key] = self._own(record.key)
            if key is None:
                self._others[namespace_of(record.key) or ""] += 1
                continue
            if key in self._strays:
                self._strays[key] += 1
            if key.endswith("/servo"):
                self._add_record(key, record)
            yield record if key == record.key else record._replace(key=key)

    def _own(self, key: str) -> str | None:
        """Return the key without its namespace; None where it is another robot's."""
        namespace = namespace_of(key)
        if namespace is None:
            # keys of which each is counted
            if meant_key(key) is not None and len(self._strays) < 100:
                self._strays[key] = 0
            return key
        if self.namespace is None:
            self.namespace = namespace
        if namespace != self.namespace:
            return None
        return key[key.index("robot/leg/") :]

    def _add_record(self, key: str, record: Record) -> None:
        leg = leg_of_key(key)
        if leg is None:
            return
        samples = self._samples.setdefault(leg, [])
        refused = self._refused.setdefault(leg, [])
        if len(samples) >= _KEPT or len(refused) >= _KEPT:
            return
        sample = decode(record.payload, ServoSample, record.encoding)
        if isinstance(sample, Rejected):
            refused.append(sample)
        else:
            samples.append(sample)

    @property
    def legs(self) -> frozenset[str]:
        """Return the legs with servo messages among the records read so far."""
        return frozenset(self._samples)

    def trouble(self, robot: Robot | None, signs: Collection[str] = ()) -> list[str]:
        """List what is wrong with keys and samples, one line each; after the pass.

        Args:
            robot: whose legs were recorded; None to look at keys only.
            signs: legs that are known to count their angles otherwise.
        """
        lines = [
            f"{count} messages under '{name}' not used: the recording is read as that of one robot "
            f"({where}); record each into a file of its own"
            for name, count in self._others.items()
            for where in [f"under '{self.namespace}'" if self.namespace else "without namespace"]
        ]
        for key, count in self._strays.most_common(_SHOWN):
            lines.append(f"{count} messages on {key} not used: did you mean {meant_key(key)}?")
        if len(self._strays) > _SHOWN:
            lines.append(f"and {len(self._strays) - _SHOWN} more such keys")
        faults = [] if robot is None else self.faults(robot)
        explains = EXPLAINS["signs"]
        for finding in entries(
            (leg, fault) for leg, fault in faults if leg not in signs or fault.cause not in explains
        ):
            legs = f"{name_legs(finding.legs)}: " if finding.legs else ""
            lines.append(f"{legs}{finding.what}; {finding.remedy}")
        return lines

    def spoilt(self, robot: Robot, *, by_rate: bool = False) -> bool:
        """Return whether no leg's samples can be judged, as :meth:`trouble` says.

        Args:
            robot: whose legs were recorded.
            by_rate: nor at another rate than the robot's, as in a learner.
        """
        causes = _SPOILS | {"period", "seq"} if by_rate else _SPOILS
        legs = [leg for leg in self._samples if leg in robot.leg_ids]
        # Counted in samples: these spoil a leg where they are in nearly half of them, or more.
        counted = {"time_type", "time_backwards", "seq"}
        spoilt = {
            leg
            for leg, fault in self.faults(robot)
            if fault.cause in causes
            and (fault.cause not in counted or self._is_frequent(leg, fault))
        }
        return bool(legs) and spoilt.issuperset(legs)

    def faults(self, robot: Robot) -> list[tuple[str, Fault]]:
        """List the faults of the samples, each with its leg; after the pass."""
        if self._faults is None:
            self._faults = list(self._check(robot))
        return self._faults

    def _check(self, robot: Robot) -> Iterator[tuple[str, Fault]]:
        for leg, samples in self._samples.items():
            facts = LegFacts.from_robot(robot, leg) if leg in robot.leg_ids else None
            faults = check_leg(
                leg,
                samples,
                self._refused[leg],
                seconds=0.0,
                period_s=robot.period_s if facts is not None else None,
                facts=facts,
            )
            for fault in faults:
                # A number that is there twice, once, is not why a recording cannot be used.
                once = fault.cause == "seq" and fault.key != "wrap"
                if fault.cause in _NAMED and (not once or self._is_frequent(leg, fault)):
                    yield leg, fault

    def _is_frequent(self, leg: str, fault: Fault) -> bool:
        return fault.size > 0.4 * len(self._samples[leg])
