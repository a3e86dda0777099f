"""Tracks a leg through its swing, compiled: phase, direction, and the foot's heights.

The functions follow the commands (:func:`update_commanded_foot`) and the readings
(:func:`update_measured_foot`) of one leg; judgements that are made once a swing are in
``swing_judge.py``.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.layout import ASKED, HEIGHTS, PATH_TICKS, SWINGS, copy_vector
from adaptive_contact.robot.gait_phase import LIFT_OFF_TICKS, infer_next_phase
from adaptive_contact.robot.kinematics import Chain

# Lengths are of a leg of 0.256 m, and in proportion for others (`Chain.size`).
# A foot this far above where it stood has left the ground.  Ground that gives, and legs that were
# pressed, let it rise before that: by less in all but one tick in a thousand on hard ground and
# on soft.
CLEARANCE_M: Final = 0.015
# Ground that gives is felt late, and a foot rises out of it for long: where it begins its swing so
# far below the reported onset, it is off the ground only above where it was so many ticks
# before that onset (``swing_judge.py``).
SUNK_M: Final = 0.006
SOFT_TICKS: Final = 12  # by then it is, all the same
# A lift in which the foot has risen by less is no evidence: it may never have left the
# ground.
LIFTED_M: Final = 0.006
# A command that takes the foot no further does not show whether the foot follows.
LEAST_WAY_M: Final = 0.015
# A foot is clear in this tick at the latest: the last pressed one let go in the 9th of its swing.
CLEAR_TICKS: Final = 11
# Without geometry the first half of a swing stands for its lift, if it holds enough ticks after the
# foot has let go; the shortest of the last few swings says how long they are.
LIFT_TICKS: Final = 10
# Ticks for which the last lack of a preview is remembered, for the note.
RECENT_TICKS: Final = 50
# Ticks after the turn to stance in which a foot that has not touched may still do so: a servo is
# three or four behind its command, and on rough ground the last feet touch when others lift off.
AFTER_TICKS: Final = 16
# Samples in a row after which a leg whose command and readings all stay as they are is not on its
# way any more: a foot that comes down moves at least one joint's reading by a step.
SAME_TICKS: Final = 2
# A swing counts as one without a touch where no tick after its turn reaches this share of
# the threshold: of 200 such swings two had a touch that lasted 40 ms (decision 27).
QUIET_SCORE: Final = 0.3
# A foot has come down where it did so by this share of its rise, or of its command's descent if
# that is less: one that met something at the top has not.
CAME_DOWN: Final = 2 / 3

UNKNOWN: Final = -1  # phase
SWING: Final = 1

# How the joints of a leg turn: one of the first two each in a straight leg, else all the last.
YAW: Final = 0
PITCH: Final = 1
ANY: Final = 2


def tabulate(chain: Chain) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Tabulate a leg's geometry for compiled code.

    Returns:
        (J, 6), the way from each joint to the next in m, and its axis; (J,) how it turns.
    """
    links = np.concatenate([np.array(chain.origins_m), chain.vectors], axis=1)
    kinds = [PITCH if axis == "pitch" else YAW for axis in chain.axes]
    axis_kinds = np.array(kinds if chain.is_straight else [ANY] * len(kinds), dtype=np.int8)
    return links, axis_kinds


# The phase, inferred from the commanded foot's height.
infer_phase: Final = compiled(infer_next_phase)


@compiled
def turned(x, y, z, links, j, cos, sin):
    """Rotate a vector about the axis of joint j (Rodrigues)."""
    a, b, c = links[j, 3], links[j, 4], links[j, 5]
    along = (a * x + b * y + c * z) * (1.0 - cos)
    return (
        x * cos + (b * z - c * y) * sin + a * along,
        y * cos + (c * x - a * z) * sin + b * along,
        z * cos + (a * y - b * x) * sin + c * along,
    )


@compiled
def forward_kinematics(angles, links):
    """Compute the place of any chain's foot in its leg's frame, m.

    Args:
        angles: (J,) rad.
        links: of :func:`tabulate`.
    """
    x = y = z = 0.0
    for j in range(len(angles) - 1, -1, -1):
        x, y, z = turned(
            x + links[j, 0], y + links[j, 1], z + links[j, 2], links, j,
            math.cos(angles[j]), math.sin(angles[j]),
        )  # fmt: skip
    return x, y, z


@compiled
def locate_foot(angles, links, axis_kinds, foot):
    """Fill the (3,) place of the foot in its leg's frame, m; see :func:`tabulate`."""
    if axis_kinds[0] == ANY:
        foot[0], foot[1], foot[2] = forward_kinematics(angles, links)
        return
    pitch = yaw = x = y = z = 0.0
    along, up, ahead, aside = 1.0, 0.0, 1.0, 0.0
    for j in range(len(angles)):
        if axis_kinds[j] == PITCH:
            pitch += angles[j]
            along, up = math.cos(pitch), math.sin(pitch)
        else:
            yaw += angles[j]
            ahead, aside = math.cos(yaw), math.sin(yaw)
        reach = links[j, 0] * along
        x += reach * ahead
        y += reach * aside
        z += links[j, 0] * up
    foot[0], foot[1], foot[2] = x, y, z


@compiled
def height_gradient(angles, links, axis_kinds, gradient):
    """Fill (J,) m per rad, how the foot rises with each joint."""
    if axis_kinds[0] == ANY:
        # The foot from each joint, and the vertical, as the link beyond the joint sees them.
        x, y, z = forward_kinematics(angles, links)
        u, v, w = 0.0, 0.0, 1.0
        for j in range(len(angles)):
            cos, sin = math.cos(angles[j]), -math.sin(angles[j])
            x, y, z = turned(x, y, z, links, j, cos, sin)
            u, v, w = turned(u, v, w, links, j, cos, sin)
            a, b, c = links[j, 3], links[j, 4], links[j, 5]
            gradient[j] = u * (b * z - c * y) + v * (c * x - a * z) + w * (a * y - b * x)
            x, y, z = x - links[j, 0], y - links[j, 1], z - links[j, 2]
        return
    pitch = beyond = 0.0
    for j in range(len(angles)):
        if axis_kinds[j] == PITCH:
            pitch += angles[j]
        gradient[j] = links[j, 0] * math.cos(pitch)
    for j in range(len(angles) - 1, -1, -1):
        beyond += gradient[j]
        gradient[j] = beyond if axis_kinds[j] == PITCH else 0.0


@compiled
def distance(a, b):
    """Compute the distance of two places, m."""
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@compiled
def forget_phase(leg):
    """Forget the inferred phase."""
    leg.swing_phase = False
    leg.apex = -np.inf
    leg.low_n = leg.low_next = leg.still = 0


@compiled
def half_swing(leg, lengths_ticks):
    """Compute half of the shortest of the last swings, ticks; 0 where none is known."""
    if leg.lengths_n == 0:
        return 0
    least = lengths_ticks[0]
    for k in range(1, min(leg.lengths_n, SWINGS)):
        least = min(least, lengths_ticks[k])
    return least // 2


@compiled
def resolve_heights(leg, foot_m, commanded_m):
    """Keep the heights of the swing that ends, and whether the foot came down as it was told."""
    leg.resolved_rise, leg.resolved_fallen = leg.rise, leg.fallen
    asked = min(leg.rise, leg.top - commanded_m)
    leg.resolved_down = leg.top - foot_m > CAME_DOWN * asked


@compiled
def stand(leg, swing, measured, desired, awaited):
    """End the swing when ``phase`` turns to stance, or continue until the touch."""
    last_desired, last_read = swing.last_desired, swing.last_read
    same = leg.has_desired
    for j in range(len(desired)):
        same &= desired[j] == last_desired[j] and measured[j] == last_read[j]
    leg.same = leg.same + 1 if same else 0
    leg.stood = True
    if leg.ticks and leg.whole and not leg.after:
        swing.lengths_ticks[leg.lengths_n % SWINGS] = leg.ticks
        leg.lengths_n += 1
    expired = leg.after == AFTER_TICKS and awaited
    if leg.ticks and awaited and leg.after < AFTER_TICKS and leg.same < SAME_TICKS:
        leg.ticks += 1
        leg.after += 1
        leg.commanded_up = False  # wherever the body goes, the foot comes down
        return
    leg.ticks = leg.after = 0
    if expired and leg.quiet >= AFTER_TICKS:
        leg.untouched += 1
        leg.untouched_ns = leg.t_ns
    leg.quiet = 0


@stage
def update_commanded_foot(leg, swing, measured, desired, awaited):
    """Update the phase, and in a swing the place that the command sends the foot to.

    Where the foot is ``awaited`` to touch, a swing goes on in stance for up to 16 ticks.  The place
    of the commanded foot is in ``swing.now``, where geometry is known.

    Returns:
        True where the swing in hand ends, as the next one begins before these are over.
    """
    links, axis_kinds, now, commanded = swing.links, swing.axis_kinds, swing.now, swing.commanded
    foot, start, phase = swing.foot, swing.start, leg.phase
    joints = len(desired)
    if phase == UNKNOWN and leg.has_lengths:
        if leg.has_phase:
            forget_phase(leg)
        leg.has_phase = False
        swinging = infer_phase(leg, now[2], swing.low)
        leg.phase_lacking = max(leg.phase_lacking - 1, 0)
    else:
        leg.has_phase = phase != UNKNOWN
        swinging = phase == SWING
        leg.phase_lacking = RECENT_TICKS if phase == UNKNOWN else max(leg.phase_lacking - 1, 0)
    ends = False
    if swinging:
        if leg.after:
            ends = True
            resolve_heights(leg, foot[2], commanded[2])
            leg.ticks = leg.after = 0
        leg.ticks += 1
        leg.same = 0
    else:
        stand(leg, swing, measured, desired, awaited)
    if leg.ticks == 1:
        leg.whole = leg.stood
    if swinging and leg.has_lengths:
        if leg.ticks == 1:
            leg.path_n = 0
            leg.path_first = leg.seq
            locate_foot(
                swing.last_desired if leg.has_desired else desired, links, axis_kinds, commanded
            )
            locate_foot(
                swing.last_measured if leg.has_measured else measured, links, axis_kinds, start
            )
            for k in range(3):
                foot[k] = start[k]
            leg.rise = leg.moved = 0.0
            leg.asked_n = 1
            swing.asked[0] = 0.0
            leg.surface = (
                leg.touch_before if start[2] < leg.touch_at - SUNK_M * leg.leg_size else -np.inf
            )
            leg.touch_at = leg.touch_before = -np.inf
            leg.top = leg.lowest_m = start[2]
            leg.fallen = np.nan
        if leg.path_n < PATH_TICKS:
            copy_vector(desired, swing.path[leg.path_n])
            leg.path_n += 1
        leg.path_last = leg.seq
        leg.commanded_up = now[2] > commanded[2]
        for k in range(3):
            commanded[k] = now[k]
    leg.has_desired = True
    for j in range(joints):
        swing.last_desired[j], swing.last_read[j] = desired[j], measured[j]
    return ends


@stage
def update_measured_foot(leg, swing, reading):
    """Update where the foot is by a reading, (J,) rad, with substitutes for bad ones."""
    foot, start, now = swing.foot, swing.start, swing.now
    for j in range(len(reading)):
        swing.last_measured[j] = reading[j]
    leg.has_measured = True
    if not leg.ticks:
        return
    if not leg.has_lengths:
        half = half_swing(leg, swing.lengths_ticks)
        leg.cleared = leg.ticks >= CLEAR_TICKS
        leg.rising = half >= LIFT_TICKS and LIFT_OFF_TICKS < leg.ticks <= half
        return
    out = foot[2] > leg.surface or leg.ticks >= SOFT_TICKS
    leg.cleared = out and (leg.rise > CLEARANCE_M * leg.leg_size or leg.ticks >= CLEAR_TICKS)
    locate_foot(reading, swing.links, swing.axis_kinds, now)
    leg.rising = now[2] > foot[2]
    for k in range(3):
        foot[k] = now[k]
    swing.heights[leg.heights_n % HEIGHTS] = now[2]
    leg.heights_n += 1
    if leg.after:
        return  # where the stance takes the foot says nothing of whether it lifted or is held
    leg.top = max(leg.top, now[2])
    leg.lowest_m = min(leg.lowest_m, now[2])
    leg.rise = max(leg.rise, now[2] - start[2])
    leg.moved = max(leg.moved, distance(now, start))
    swing.asked[leg.asked_n % ASKED] = distance(swing.commanded, start)
    leg.asked_n += 1


@compiled
def descending(leg, lengths_ticks):
    """Return whether the command in force is past the lift; without geometry, the time decides."""
    if not leg.has_lengths:
        return leg.ticks > max(2 * LIFT_OFF_TICKS, half_swing(leg, lengths_ticks))
    return leg.descent and leg.ticks > LIFT_OFF_TICKS
