r"""Reads legs from a URDF: joints, axes, origins and limits, by the links that are the feet.

Only the standard library's XML parser is used, and of the file only its links and joints: no mesh
is opened, no package is resolved, nothing is loaded from anywhere.  Documents with a DOCTYPE, and
so with entities, are refused, as are large and deeply nested ones.

With all joints at 0 the transforms down the tree turn each joint's axis into the body's frame, so
that :math:`a_i` and :math:`o_i` of a chain (:mod:`adaptive_contact.robot.kinematics`) are read off.
The legs' frames are parallel to the body link's, whose z is up (ROS REP 103).

Reference:
    The URDF specification, wiki.ros.org/urdf/XML/joint.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree
from xml.parsers.expat import errors

from adaptive_contact.arrays import Array, np
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import read_file
from adaptive_contact.printable import did_you_mean, printable
from adaptive_contact.robot.description import Leg, Limits, Mount
from adaptive_contact.robot.kinematics import Vector, rotation

MOST_BYTES: Final = 8_000_000
MOST_DEPTH: Final = 64
# Joints of any kind from the root to a foot; legs of 16 that turn have two fixed ones beside each.
_LONGEST_PATH: Final = 100
# Joints that turn, and that leave a leg as it is.
_TURNING: Final = ("revolute", "continuous")
_NO_LEG_S: Final = ("fixed", "floating", "planar")
_KINDS: Final = (*_TURNING, *_NO_LEG_S, "prismatic")
# What only stands below <robot> until xacro has run, with any prefix or none.
_XACRO: Final = ("arg", "if", "include", "macro", "property", "unless")
# Digits of what is written, m and parts of an axis: files have pi with as few.
_DIGITS: Final = 6
_SNAP: Final = 2e-5
_LISTED: Final = 12
# Links of these names are listed first where feet are asked for.
_FOOT: Final = re.compile("foot|feet|toe|sole|tip|ankle", re.IGNORECASE)


@dataclasses.dataclass
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector
    lower: float
    upper: float
    mimics: str | None

    @property
    def limits(self) -> tuple[float, float] | None:
        """Return its range within a turn each way, rad; None where there is none."""
        low, high = max(self.lower, -math.tau), min(self.upper, math.tau)
        return (low, high) if low < high else None


@dataclasses.dataclass(frozen=True)
class UrdfLegs:
    """Holds what a file says of a robot's legs."""

    name: str  # of the robot; empty where it has none
    base: str  # the link that is the body
    legs: tuple[Leg, ...]  # in the order asked for
    notes: tuple[str, ...]  # for the operator, one line each


class _Builder(ElementTree.TreeBuilder):
    """Builds the tree of a document that is no danger to do so."""

    depth = 0

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise _RefusedError(f"nested more than {MOST_DEPTH} deep; expected a URDF")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ElementTree.Element:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, name: str, *_: object) -> None:
        raise _RefusedError(
            f"has <!DOCTYPE {printable(name)}>; expected a URDF's <robot>, with no DOCTYPE and so "
            "no entities: remove it"
        )


class _RefusedError(Exception):
    """Ends the parser early; says why."""


class Urdf:
    """Reads the links and joints of a URDF.

    Args:
        data: the file's bytes.
        source: names it in errors.

    Raises:
        ConfigurationError: in one line, what is wrong in it and what to do.
    """

    def __init__(self, data: bytes, source: str) -> None:
        self.source = source
        root = self._parsed(data)
        self.name = printable(root.get("name", "")).strip()
        self.links = [self._named(link) for link in root.iterfind("link")]
        self._joints = [self._joint(joint) for joint in root.iterfind("joint")]
        self._parents = self._tree()

    def legs(
        self,
        feet: Mapping[str, str],
        *,
        base: str | None = None,
        tips_m: Sequence[Sequence[float]] = (),
    ) -> UrdfLegs:
        """Read off legs.

        Args:
            feet: the foot's link by leg id.
            base: the link that is the body; without it, the last one that all legs hang on.
            tips_m: of the feet's tips in the frames of their links, one for all or one each.

        Raises:
            ConfigurationError: the file has no such legs, or no chain describes one.
        """
        paths = {leg: self._path(leg, link) for leg, link in feet.items()}
        roots = {path[0].parent if path else feet[leg] for leg, path in paths.items()}
        if len(roots) > 1:
            raise self._error(
                f"legs hang on several roots ({', '.join(sorted(roots))}); expected one tree of "
                "links: join them by a fixed joint"
            )
        body = self._body(paths, roots.pop(), base)
        owners: dict[str, str] = {}
        legs, free, raised = [], [], []
        tips = list(tips_m) or [(0.0, 0.0, 0.0)]
        if len(tips) not in (1, len(feet)):
            raise ConfigurationError(
                f"--tip has {len(tips)} points for {len(feet)} legs; give one, or X,Y,Z/X,Y,Z/... "
                "in the order of --legs"
            )
        for (leg, path), tip_m in zip(paths.items(), tips * (len(feet) // len(tips)), strict=True):
            chain = list(itertools.dropwhile(lambda joint: joint.parent != body, path))
            for joint in chain:
                if joint.kind in _TURNING and owners.setdefault(joint.name, leg) != leg:
                    raise self._error(
                        f"joint '{joint.name}' moves leg '{owners[joint.name]}' and leg '{leg}'; "
                        "a joint belongs to one leg: describe these legs as robots of their own, "
                        "or give --base the link below it"
                    )
            legs.append(self._leg(leg, chain, feet[leg], body, tip_m))
            free += [j.name for j in chain if j.kind in _TURNING and j.limits is None]
            raised += [leg] if _is_raised(legs[-1]) else []
        above = ", ".join(j.name for j in self._above(body) if j.kind not in _NO_LEG_S)
        legs_own = {joint.name for joint in (*itertools.chain(*paths.values()), *self._above(body))}
        beside = [j for j in self._joints if j.name not in legs_own and j.kind not in _NO_LEG_S]
        listed = ", ".join(j.name for j in beside[:_LISTED]) + ", …" * (len(beside) > _LISTED)
        notes = {
            f"left out, as they lead to no foot: joint {listed}": beside,
            f"the body is link '{body}': joints above it ({above}) are no leg's": above,
            f"no limits for joint {', '.join(free)}; fill in limits before the bridge drives "
            "it": free,
            f"leg {', '.join(raised)}: the foot is above its first joint, at 0 and in mid-range; "
            f"is z of link '{body}' up? if not, give --base a link whose z is": raised,
        }
        said = tuple(note for note, found in notes.items() if found)
        return UrdfLegs(self.name, body, tuple(legs), said)

    # -- the file ----------------------------------------------------------------------------------

    def _parsed(self, data: bytes) -> ElementTree.Element:
        try:
            root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))
        except _RefusedError as refused:
            raise self._error(str(refused)) from None
        except (ElementTree.ParseError, LookupError, ValueError) as error:
            # The latter two are of an encoding that the parser does not know.
            code, (line, _) = 0, getattr(error, "position", (1, 0))
            if isinstance(error, ElementTree.ParseError):
                code = error.code
            reason = errors.messages.get(code, printable(str(error)))
            raise self._error(
                f"line {line}: no XML that can be read ({reason}); expected a URDF: "
                "correct the line, or save the file as UTF-8"
            ) from error
        if root.tag != "robot":
            raise self._error(
                f"begins with <{printable(root.tag)}>; expected a URDF's <robot>: give a URDF, or "
                "write axes and origins_m by hand (docs/robot.md)"
            )
        left = [element for element in root.iter() if "xacro" in element.tag]
        left += [element for element in root if element.tag.rpartition("}")[2] in _XACRO]
        for element in (*root, *root.iterfind("joint/*")):
            text = " ".join(element.attrib.values())
            left += [element] if "${" in text or "$(" in text else []
        if left:
            raise self._error(
                f"<{printable(left[0].tag.rpartition('}')[2])}> is xacro, not expanded; run "
                "`xacro FILE > robot.urdf` where ROS is installed, and give that file"
            )
        return root

    def _named(self, element: ElementTree.Element) -> str:
        name = element.get("name", "").strip()
        if not name:
            raise self._error(f"a <{element.tag}> has no name; give it one")
        if not name.isprintable():
            raise self._error(f"a <{element.tag}> has a name that cannot be printed; rename it")
        return name

    def _joint(self, element: ElementTree.Element) -> _Joint:
        name, kind = self._named(element), element.get("type", "")
        if kind not in _KINDS:
            raise self._error(
                f"joint '{name}' has type '{printable(kind)}'; expected one of {', '.join(_KINDS)}"
            )
        parts = {part.tag: part.attrib for part in element}

        def numbers(tag: str, key: str, otherwise: str) -> list[float]:
            return self._numbers(name, key, parts.get(tag, {}).get(key, otherwise))

        def vector(tag: str, key: str, otherwise: str = "0 0 0") -> Vector:
            values = numbers(tag, key, otherwise)
            if len(values) != 3:
                raise self._error(f"joint '{name}': {key} has {len(values)} numbers; expected 3")
            return values[0], values[1], values[2]

        turns = kind == "revolute"
        return _Joint(
            name,
            kind,
            parent=parts.get("parent", {}).get("link", "").strip(),
            child=parts.get("child", {}).get("link", "").strip(),
            xyz=vector("origin", "xyz"),
            rpy=vector("origin", "rpy"),
            axis=vector("axis", "xyz", "1 0 0"),
            lower=sum(numbers("limit", "lower", "0")) if turns else 0.0,
            upper=sum(numbers("limit", "upper", "0")) if turns else 0.0,
            mimics=parts["mimic"].get("joint", "") if "mimic" in parts else None,
        )

    def _numbers(self, joint: str, key: str, text: str) -> list[float]:
        values = []
        for part in text.split():
            try:
                values.append(float(part))
            except ValueError:
                values.append(math.nan)
            if not math.isfinite(values[-1]):
                raise self._error(
                    f"joint '{joint}': {key} has {printable(part)!r}; expected a number such as "
                    "0.05"
                )
        return values

    # -- the tree ----------------------------------------------------------------------------------

    def _tree(self) -> dict[str, _Joint]:
        """Return the joint that carries each link but the roots."""
        for names, what in ((self.links, "link"), ([j.name for j in self._joints], "joint")):
            seen: set[str] = set()
            for name in names:
                if name in seen:
                    raise self._error(f"{what} '{name}' is there twice; names must differ")
                seen.add(name)
        if not self.links:
            raise self._error("has no <link>; expected a URDF with links and joints")
        parents: dict[str, _Joint] = {}
        known = set(self.links)
        for joint in self._joints:
            for end, link in (("parent", joint.parent), ("child", joint.child)):
                if link not in known:
                    raise self._error(
                        f"joint '{joint.name}' has the {end} link "
                        f"'{printable(link)}'; there is no such <link>"
                    )
            if joint.child in parents:
                raise self._error(
                    f"link '{joint.child}' hangs on joint "
                    f"'{parents[joint.child].name}' and on joint '{joint.name}'; expected a tree: "
                    "a loop (a parallel linkage) is no chain, see docs/robot.md"
                )
            parents[joint.child] = joint
        return parents

    def _path(self, leg: str, link: str) -> list[_Joint]:
        if link not in self.links:
            hint = did_you_mean(link, self.links, f"its last links: {self.last_links()}", 0.5)
            raise self._error(f"leg '{leg}': there is no link '{link}'; {hint}")
        path = self._above(link)[::-1]
        if len(path) > _LONGEST_PATH:
            raise self._error(
                f"leg '{leg}': more than {_LONGEST_PATH} joints lead to link '{link}', or links "
                "hang on each other in a circle; expected a tree of links"
            )
        return path

    def last_links(self) -> str:
        """Describe the links that carry no other and that joints move, for the operator."""
        carrying = {joint.parent for joint in self._joints}
        ends = [link for link in self.links if link not in carrying]
        moved = [link for link in ends if any(j.kind in _TURNING for j in self._above(link))]
        tips = sorted(moved, key=lambda link: not _FOOT.search(link))
        more = f" and {len(tips) - _LISTED} more" if len(tips) > _LISTED else ""
        return ", ".join(tips[:_LISTED] or ["none"]) + more

    def _above(self, link: str) -> list[_Joint]:
        above: list[_Joint] = []
        while link in self._parents and len(above) <= _LONGEST_PATH:
            above.append(self._parents[link])
            link = self._parents[link].parent
        return above

    def _body(self, paths: Mapping[str, Sequence[_Joint]], root: str, base: str | None) -> str:
        """Return the link from which the legs' mounts are measured."""
        links = [[root, *(joint.child for joint in path)] for path in paths.values()]
        if base is not None:
            for leg, own in zip(paths, links, strict=True):
                if base not in own:
                    raise self._error(
                        f"--base '{base}' carries no leg '{leg}'; links that do: {', '.join(own)}"
                    )
            return base
        shared = 0
        while all(len(own) > shared + 1 for own in links) and (
            len({own[shared + 1] for own in links}) == 1
        ):
            # Of one leg alone, its own joints are above all its links.
            if len(links) == 1 and self._parents[links[0][shared + 1]].kind not in _NO_LEG_S:
                break
            shared += 1
        return links[0][shared]

    # -- a leg -------------------------------------------------------------------------------------

    def _leg(
        self, leg: str, path: Sequence[_Joint], foot: str, body: str, tip_m: Sequence[float]
    ) -> Leg:
        turn, place = np.eye(3), np.zeros(3)
        joints: list[_Joint] = []
        axes: list[Array] = []
        points: list[Array] = []
        for joint in path:
            self._check_kind(leg, joint)
            place = place + turn @ np.array(joint.xyz)
            turn = turn @ _rotation(joint.rpy)
            if joint.kind != "fixed":
                length = math.hypot(*joint.axis)
                if not 1e-6 <= length < math.inf:
                    shown = " ".join(f"{part:g}" for part in joint.axis)
                    raise self._error(
                        f"joint '{joint.name}' has the axis {shown}; expected a "
                        "direction such as 0 1 0"
                    )
                joints.append(joint)
                axes.append(turn @ np.array(joint.axis) / length)
                points.append(place)
        if not joints:
            raise self._error(
                f"leg '{leg}': no joint below link '{body}' turns link '{foot}'; give the link of "
                f"its foot, and --base the link of the body; last links: {self.last_links()}"
            )
        points.append(place + turn @ np.array(tip_m))
        origins = np.diff(points, axis=0)
        if not np.abs(origins[-1]).max() > _SNAP:
            raise self._error(
                f"leg '{leg}': link '{foot}' begins in joint '{joints[-1].name}', which is not "
                "where the foot touches; give a link at the tip, or --tip X,Y,Z of the tip in that "
                "link's frame, m"
            )
        made = Leg(
            id=leg,
            joints=tuple(joint.name for joint in joints),
            axes=tuple(_written(axis) for axis in axes),
            origins_m=tuple(_written(origin) for origin in origins),
            mount=Mount(xyz_m=_written(points[0])),
            limits=_limits(joints),
        )
        assert made.chain is not None
        if not made.chain.raises_foot:
            raise self._error(
                f"leg '{leg}': no joint raises its foot; is z of link '{body}' up? give --base a "
                "link whose z is"
            )
        return made

    def _check_kind(self, leg: str, joint: _Joint) -> None:
        where = f"leg '{leg}': joint '{joint.name}'"
        if joint.kind not in (*_TURNING, "fixed"):
            raise self._error(
                f"{where} is {joint.kind}; expected revolute, continuous or fixed in a leg: give "
                "--base a link below it, or another foot"
            )
        if joint.mimics is not None and joint.kind in _TURNING:
            raise self._error(
                f"{where} follows joint '{printable(joint.mimics)}' (mimic); remove its <mimic> if "
                "your source publishes this joint's own angle (docs/robot.md, What a chain cannot "
                "describe)"
            )

    def _error(self, what: str) -> ConfigurationError:
        return ConfigurationError(f"{self.source}: {what}")


def read_urdf(path: Path) -> Urdf:
    """Read a file.

    Raises:
        ConfigurationError: it cannot be read, or is no URDF.
    """
    advice = "give the path of a URDF; meshes are files of their own"
    return Urdf(read_file(path, advice, most=MOST_BYTES), str(path))


def _rotation(rpy: Vector) -> Array:
    """Return the (3, 3) matrix of fixed-axis roll, pitch and yaw."""
    roll, pitch, yaw = (rotation(axis, angle) for axis, angle in zip(np.eye(3), rpy, strict=True))
    return yaw @ pitch @ roll


def _written(vector: Array) -> Vector:
    """Round a vector as descriptions have it, without what few digits of pi have made."""
    nearest = np.rint(vector)
    snapped = np.where(np.abs(vector - nearest) < _SNAP, nearest, vector)
    x, y, z = (_rounded(float(part)) for part in snapped)
    return x, y, z


def _is_raised(leg: Leg) -> bool:
    """Return whether the foot is above its first joint where a leg hardly has it."""
    chain, postures = leg.chain, [[0.0] * len(leg.joints)]
    assert chain is not None
    if leg.limits is not None:
        ends = zip(leg.limits.lower_rad, leg.limits.upper_rad, strict=True)
        postures.append([(low + high) / 2 for low, high in ends])
    # A foot this share of the leg's reach above its first joint is not how a robot stands.
    return all(chain.foot(q)[2] > 0.1 * chain.reach_m for q in postures)


def _limits(joints: Sequence[_Joint]) -> Limits | None:
    """Limits of all joints: one turn for those without, if others have them."""
    if not any(joint.limits for joint in joints):
        return None
    ends = [joint.limits or (-math.pi, math.pi) for joint in joints]
    return Limits(*(tuple(map(_rounded, side)) for side in zip(*ends, strict=True)))


def _rounded(value: float) -> float:
    return round(value, _DIGITS) + 0.0
