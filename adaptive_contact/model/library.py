r"""Defines the candidate libraries: the terms a leg model may be made of.

``servo``
    what the physics of a position servo says.  With :math:`e = \theta^{des} - \theta`, velocities
    in rad per tick and :math:`\mathrm{sat}(x) = \min(1, \max(-1, x))`: a constant, positions,
    position and command differences, the saturating control law
    :math:`\mathrm{sat}(e/s)` at the present and past commands and half a tick on, where the joint
    will have moved by :math:`v/2`, Coulomb friction
    :math:`\tanh(v/v_0)`, back-EMF and viscous friction (the differences), gravity
    :math:`\cos\phi, \sin\phi` of the absolute link angles (:mod:`.gravity`).
``paper``
    the paper's Eq. 8: sine, cosine and all polynomials up to degree 2 of every position and
    command in the window.
``linear``
    a constant, the positions and the commands.

Every library predicts the increment :math:`\theta[k+1] - \theta[k]`: a ridge term then pulls
towards "no motion" rather than towards the zero position.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from itertools import combinations_with_replacement, pairwise
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model.gravity import GravityAngle, gravity_angles
from adaptive_contact.model.window import Window
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.description import Axis

LibraryName = Literal["servo", "paper", "linear"]

# Knee of the friction shape, rad per second: the Stribeck region of small gear servos ends at
# 0.1 to 0.3 rad/s (Rhoban/bam identifications); the readings do not resolve less.
FRICTION_KNEE_RAD_S: Final = 0.5
# Knees of friction against a predicted movement, rad per second: from the command that makes a
# joint break away to its fastest movement.
CHANGE_KNEES_RAD_S: Final = (0.3, 1.0, 3.0)
# The library offers the control law at the described slope and at its neighbours, so that wear
# or a wrong register value stays inside its span.
SLOPE_FACTORS: Final = (1.0, 0.5, 2.0)


class _ServoShape(NamedTuple):
    """Computes the ``servo`` library by one product and functions of ranges of its columns."""

    linear: Array  # (window, p), what each column is of the flat window before any function
    clipped: slice  # columns that saturate at ±1
    curved: tuple[tuple[slice, np.ufunc], ...]  # ranges of columns, each with its function


class TermGroup(NamedTuple):
    """Describes terms of one form, one of every joint, side by side."""

    form: str  # name, with ``{}`` for the joint
    first: int  # column of the first joint's
    bounded: bool  # a joint's range or its servo's law bound it; a command's step has no bound


@dataclasses.dataclass(frozen=True)
class Library:
    """Evaluates a named set of terms over a window."""

    name: LibraryName  # which of the libraries above
    joints: tuple[str, ...]  # (J,) names, from the body outwards
    axes: tuple[Axis, ...]  # (J,) a word or a unit vector, with all angles 0
    window: Window = dataclasses.field(default_factory=Window)  # past and future it looks at
    slope_rad: float = 0.164  # s of the servo's control law
    period_s: float = 0.02  # control tick, for the friction knee

    def __post_init__(self) -> None:
        if self.name not in get_args(LibraryName):
            raise ConfigurationError(
                f"library is '{self.name}'; expected one of {', '.join(get_args(LibraryName))}"
            )
        if len(self.axes) != len(self.joints):
            raise ConfigurationError(
                f"library: {len(self.axes)} axes for {len(self.joints)} joints"
            )

    @property
    def size(self) -> int:
        """Return the number of terms, p."""
        return len(self.names)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of every term, in the order of :meth:`evaluate`'s columns."""
        return self._all_names()

    def _all_names(self) -> tuple[str, ...]:
        if self.name == "servo":
            return tuple(self._servo_names())
        columns = self._variable_names()
        if self.name == "linear":
            return ("1", *columns)
        pairs = combinations_with_replacement(range(len(columns)), 2)
        return (
            "1",
            *columns,
            *(f"sin({c})" for c in columns),
            *(f"cos({c})" for c in columns),
            *(f"{columns[i]} {columns[j]}" for i, j in pairs),
        )

    def evaluate(self, measured: Array, desired: Array, preview: Array) -> Array:
        """Compute Θ.

        Args:
            measured: (..., N + 1, J) rad, lag 0 first.
            desired: (..., N' + 1, J) rad, lag 0 first.
            preview: (..., M, J) rad, next command first.

        Returns:
            (..., p).
        """
        parts = [_flat(part) for part in (measured, desired, preview)]
        return self.evaluate_flat(np.concatenate(parts, axis=-1))

    def evaluate_flat(self, window: Array) -> Array:
        """Compute Θ of windows laid out in a row.

        Args:
            window: (..., (N + 1) J + (N' + 1) J + M J) rad: measured, desired and preview, each
                lag by lag as in :meth:`evaluate`.

        Returns:
            (..., p).
        """
        if self.name == "servo":
            return self._servo(window)
        one = np.ones((*window.shape[:-1], 1))
        if self.name == "linear":
            return np.concatenate([one, window], axis=-1)
        first, second = self._pairs
        products = window[..., first] * window[..., second]
        return np.concatenate([one, window, np.sin(window), np.cos(window), products], axis=-1)

    @cached_property
    def _pairs(self) -> tuple[Ints, Ints]:
        pairs = combinations_with_replacement(range(len(self._variable_names())), 2)
        first, second = np.array(list(pairs), dtype=np.int64).T
        return first, second

    @cached_property
    def gravity(self) -> tuple[GravityAngle, ...]:
        """Return the angles whose cosine and sine gravity acts by."""
        return gravity_angles(self.joints, self.axes)

    def _variable_names(self) -> list[str]:
        w = self.window
        spans = [
            ("θ", [-lag for lag in range(w.past_measured + 1)]),
            ("u", [-lag for lag in range(w.past_desired + 1)]),
            ("u", list(range(1, w.preview + 1))),
        ]
        return [
            f"{symbol}_{joint}{_at(offset)}"
            for symbol, offsets in spans
            for offset in offsets
            for joint in self.joints
        ]

    def _servo(self, window: Array) -> Array:
        theta = np.asarray(window @ self._servo_shape.linear)
        self._bend(theta)
        return theta

    def _bend(self, theta: Array) -> None:
        """Apply the functions of the terms, in place."""
        shape = self._servo_shape
        theta[..., 0] = 1.0
        clipped = theta[..., shape.clipped]
        np.minimum(clipped, 1.0, out=clipped)
        np.maximum(clipped, -1.0, out=clipped)
        for columns, function in shape.curved:
            part = theta[..., columns]
            function(part, out=part)

    @cached_property
    def _servo_shape(self) -> _ServoShape:
        w, joints = self.window, len(self.joints)
        depths = (w.past_measured + 1, w.past_desired + 1, w.preview)
        # Each row of the identity is a window with one entry: what is linear in it gives a matrix.
        unit = np.eye(sum(depths) * joints)
        edges = np.cumsum([0, *depths]) * joints
        measured, desired, preview = (
            unit[:, first:last].reshape(len(unit), -1, joints)
            for first, last in pairwise(edges.tolist())
        )
        position = measured[:, 0]
        velocity = measured[:, :-1] - measured[:, 1:]
        depth = min(w.past_measured, w.past_desired) + 1
        error = (desired[:, :depth] - measured[:, :depth]) / self.slope_rad
        # The command of the tick before against the position it led to: what the servo still
        # pushed with just before the new command came.
        left = (desired[:, 1:depth] - measured[:, : depth - 1]) / self.slope_rad
        weights = np.array([angle.weights for angle in self.gravity]).reshape(-1, joints)
        angles = position @ weights.T
        knee = FRICTION_KNEE_RAD_S * self.period_s
        straight = [
            np.zeros((len(unit), 1)),  # the constant
            position,
            _flat(velocity),
            error[:, 0],
            _flat(desired[:, :-1] - desired[:, 1:]),
        ]
        clipped = [_flat(error), _flat(left), *(error[:, 0] / f for f in SLOPE_FACTORS[1:])]
        if w.past_measured:  # the joint moves on while the command is in force
            clipped.append(error[:, 0] - velocity[:, 0] / 2.0 / self.slope_rad)
        friction = [velocity[:, 0] / knee] if w.past_measured else []
        ahead = [_flat(preview - desired[:, :1])] if w.preview else []
        groups = (straight, clipped, friction, [angles], [angles], ahead)
        widths = [sum(part.shape[1] for part in group) for group in groups]
        bounds = [slice(*pair) for pair in pairwise(np.cumsum([0, *widths]).tolist())]
        return _ServoShape(
            linear=np.concatenate([part for group in groups for part in group], axis=1),
            clipped=bounds[1],
            curved=((bounds[2], np.tanh), (bounds[3], np.cos), (bounds[4], np.sin)),
        )

    @cached_property
    def groups(self) -> tuple[TermGroup, ...]:
        """Return groups of one term per joint; none if the library's terms mix joints."""
        if self.name != "servo":
            return ()
        w, joints = self.window, len(self.joints)
        depth = min(w.past_measured, w.past_desired) + 1
        forms = ["θ_{}"]
        forms += [f"v_{{}}{_at(-lag)}" for lag in range(w.past_measured)]
        forms += ["e_{}/s"]
        forms += [f"Δu_{{}}{_at(-lag)}" for lag in range(w.past_desired)]
        forms += [f"sat(e_{{}}{_at(-lag)}/s)" for lag in range(depth)]
        forms += [f"sat(e⁻_{{}}{_at(-lag)}/s)" for lag in range(depth - 1)]
        forms += [f"sat(e_{{}}/{f:g}s)" for f in SLOPE_FACTORS[1:]]
        if w.past_measured:
            forms += ["sat((e_{}-v_{}/2)/s)", "tanh(v_{}/v₀)"]
        firsts = [1 + joints * i for i in range(len(forms))]
        ahead = [f"u_{{}}{_at(lead)}-u_{{}}" for lead in range(1, w.preview + 1)]
        behind = 1 + joints * len(forms) + 2 * len(self.gravity)
        firsts += [behind + joints * i for i in range(len(ahead))]
        # Forms of terms that grow with the command, however far it steps.
        return tuple(
            TermGroup(form, first, not form.startswith(("e_", "Δu_", "u_")))
            for form, first in zip(forms + ahead, firsts, strict=True)
        )

    def window_of(self, theta: Array) -> Array:
        """Recover windows from their terms, of a ``servo`` library without preview.

        Args:
            theta: (..., p).

        Returns:
            As :meth:`evaluate_flat` takes them.
        """
        first = {group.form: group.first for group in self.groups}

        def term_columns(form: str, lag: int = 0) -> Array:
            at = first[form + _at(-lag)]
            return theta[..., at : at + len(self.joints)]

        rows = [term_columns("θ_{}")]
        for lag in range(self.window.past_measured):
            rows.append(rows[-1] - term_columns("v_{}", lag))
        rows.append(rows[0] + self.slope_rad * term_columns("e_{}/s"))
        for lag in range(self.window.past_desired):
            rows.append(rows[-1] - term_columns("Δu_{}", lag))
        return np.concatenate(rows, axis=-1)

    @property
    def moves(self) -> Mask:
        """Return which terms, (p,), depend on motion; the others depend on the position."""
        of_motion = np.zeros(self.size, dtype=bool)
        for group in self.groups:
            of_motion[group.first : group.first + len(self.joints)] = group.form != "θ_{}"
        return of_motion

    def _servo_names(self) -> list[str]:
        turned = [f"{of} {angle.name}" for of in ("cos", "sin") for angle in self.gravity]
        behind = 1 + len(self.joints) * sum(not g.form.startswith("u_") for g in self.groups)
        names = ["1", *(g.form.replace("{}", j) for g in self.groups for j in self.joints)]
        return names[:behind] + turned + names[behind:]


@dataclasses.dataclass(frozen=True)
class ChangeLibrary(Library):
    r"""Adds to a library the terms of a change, which its first model's prediction shapes.

    With :math:`\delta = \Xi_0^\top \Theta` the movement that the model of the leg as it was first
    known predicts:

    - friction, :math:`\tanh(\delta_j / \kappa)` for several knees κ, as what stops a slow joint
      only slows a fast one.  Against the movement *before*, as in ``servo``, a joint that is about
      to break away or to turn looks free of friction;
    - softness, :math:`\delta_j(2s) - \delta_j`, what the same joint would do with a control law of
      twice the slope in place of its own; only of a library that knows the law.

    Libraries that differ in Ξ₀ only are equal: their legs can share arrays.

    Attributes:
        first: (q, J) Ξ₀, of the q terms that the library has without these.
    """

    first: Array = dataclasses.field(compare=False, repr=False, kw_only=True)

    @cached_property
    def over_knees(self) -> Array:
        """Return the first model's coefficients over each knee, (q, K J), for friction terms."""
        knees = [knee * self.period_s for knee in CHANGE_KNEES_RAD_S]
        return np.concatenate([self.first / knee for knee in knees], axis=1)

    @cached_property
    def softening(self) -> Array:
        """Return the first model's coefficients of the law's terms, (c, J)."""
        return self.first[self._servo_shape.clipped] if self.knows_law else self.first[:0]

    @property
    def knows_law(self) -> bool:
        """Return whether the servo's control law is among the terms."""
        return self.name == "servo"

    def parts(self, window: Array) -> tuple[Array, Array]:
        """Return what the terms are made of that all legs of equal libraries share.

        Returns:
            (..., q) the terms without changes; (..., c) by how much those of the law would be
            other with twice the slope.
        """
        if not self.knows_law:
            theta = super().evaluate_flat(window)
            return theta, theta[..., :0]
        shape = self._servo_shape
        theta = np.asarray(window @ shape.linear)
        softer = 0.5 * theta[..., shape.clipped]
        self._bend(theta)
        np.minimum(softer, 1.0, out=softer)
        np.maximum(softer, -1.0, out=softer)
        softer -= theta[..., shape.clipped]
        return theta, softer

    def evaluate_flat(self, window: Array) -> Array:
        """Compute Θ; see :meth:`Library.evaluate_flat`."""
        theta, softer = self.parts(window)
        changes = [np.tanh(theta @ self.over_knees)]
        if self.knows_law:
            changes.append(softer @ self.softening)
        return np.concatenate([theta, *changes], axis=-1)

    def _all_names(self) -> tuple[str, ...]:
        rub = [name for j in zip(*map(friction_terms, self.joints), strict=True) for name in j]
        soft = [soft_term(j) for j in self.joints] if self.knows_law else []
        return (*super()._all_names(), *rub, *soft)


def friction_terms(joint: str) -> tuple[str, ...]:
    """Return the names of a joint's friction terms against the first model's prediction."""
    return tuple(f"tanh(δ_{joint}/{knee:g})" for knee in CHANGE_KNEES_RAD_S)


def soft_term(joint: str) -> str:
    """Return the name of the term of a joint half as stiff."""
    return f"δ_{joint}(2s)-δ_{joint}"


def with_changes(library: Library, first: Array) -> ChangeLibrary:
    """Return a library with the terms of a change added.

    Args:
        library: plain.
        first: (q, J) coefficients of its terms, of the leg as it was first known.
    """
    own = {f.name: getattr(library, f.name) for f in dataclasses.fields(Library)}
    return ChangeLibrary(**own, first=first)


def plain_of(library: Library) -> Library:
    """Return the library without the terms of a change."""
    return Library(**{f.name: getattr(library, f.name) for f in dataclasses.fields(Library)})


def leg_library(
    robot: Robot, leg: Leg, name: LibraryName = "servo", window: Window | None = None
) -> Library:
    """Return the library of a leg, from the robot's description."""
    return Library(
        name=name,
        joints=leg.joints,
        axes=leg.joint_axes,
        window=window or Window(),
        slope_rad=robot.servo.slope_rad,
        period_s=robot.period_s,
    )


def _flat(values: Array) -> Array:
    """Reshape (..., m, J) to (..., m J), also for no rows, where -1 is not possible."""
    *lead, depth, joints = values.shape
    return values.reshape(*lead, depth * joints)


def _at(offset: int) -> str:
    """Format an offset: nothing for ``[k]``; ``[k-1]``, ``[k+2]``."""
    return "" if offset == 0 else f"[k{offset:+d}]"
