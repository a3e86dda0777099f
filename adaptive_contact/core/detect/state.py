r"""Estimates in every tick, stance included, how probable it is that a foot carries; compiled.

What is seen is the residual of free motion :math:`r`, also in a stance, where no contact is
decided:

- the *push* :math:`g \cdot r`, with the foot's height over each joint :math:`g`: by how much the
  foot stands higher than it would without ground;
- the *misfit*, the logarithm of the whitened length of :math:`r`.

Both are measured in their own free sizes: medians over the ticks in which the command is in the
upper half of the leg's own range.  A leg that has changed is so judged by what it does since.  The
push of the last ticks is added up with a forgetting of one half a tick.  Residuals of neighbouring
ticks are not independent: a longer sum is too sure, and no better.

Averaged over stances, the push is the *load*: it says whether a leg carries or hangs (decision 53).
By it, a leg is judged after the turn or not, and one that began with a prior learns all of its
swing.

The commanded height sets odds and is no evidence: it stays within :data:`MOST_NATS`.  So p is
unknown until a stance has departed from the free path, as that of a robot that hangs never does.

The weights are of a logistic regression over robots of two physics engines.  What they give on
robots that were left out: ``python -m adaptive_contact_studies.state``.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled, stage
from adaptive_contact.core.detect.contact import context_of
from adaptive_contact.core.detect.swing import height_gradient

# Log-odds: constant, sum of pushes, misfit.
WEIGHTS: Final = (-4.0, 0.43, 1.2)
FORGETTING: Final = 0.5  # of the sum, a tick
BOUND: Final = 4.0  # sizes; a larger push is no surer
# The command's odds: at most so many nats, and none at this share of the leg's range.
MOST_NATS: Final = 2.0
EVEN_SHARE: Final = 0.35
STEEPNESS: Final = 4.0
# A step of the logarithm of a median, a tick, once this many are behind it: an e-fold in 10 s.
STEP: Final = 0.01
FULL_TICKS: Final = 720  # before, steps are longer
KNOWN_TICKS: Final = 20
GIVEN_TICKS: Final = 10  # that the sizes of a baseline are worth
# A size is at least this share of a loaded push: the quantile over the lower half of the range.
# Without it, a leg whose free residuals are very small touches before it does.
LOADED_SIZES: Final = 12.0
LOADED_QUANTILE: Final = 0.7
LEAST_QUANTA: Final = 0.1  # position steps, below which no size gets
# The ends of the range come in by this share of the way to the newest command, a tick.
RANGE_LEAK: Final = 1.0 / 3000.0
LEAST_RANGE_M: Final = 0.01  # of the hexapod's legs; within less nothing is high or low
# A stance has departed from the free path after so long above so many sizes.  In 25 legs that hung
# for a minute none did; with 2.5 sizes and 100 ms, four did.
PRESSED_NS: Final = 160_000_000
PRESSED: Final = 3.0
# And p is unknown again after so long of low commands without that: the robot may hang by now.
IDLE_NS: Final = 20_000_000_000
# The sum of pushes, averaged over so long after the turn and over the last stances, is the load: a
# leg carries above `carries_push`, and hangs below `hangs_push`.
STANCE_NS: Final = 240_000_000
LEAST_STANCES, STANCES = 3, 8
# Or where the last stances have all pushed against the motion by this sum (`add_push`): legs that
# hang come to 9 in one of ten, the rear legs of a robot of stiff drives to 23 in half of them.
PRESSED_SUM: Final = 12.0
# A leg that began with a prior and carried is lifted where its load is below this share of what it
# was over so many stances.  Legs that walk stay above 0.75, over planned holes above 0.3; lifted
# ones fall below 0.4 within a dozen stances, as in the air the model of a stance errs.
CARRIED_STANCES, CARRIED_SHARE = 40, 0.4
# A leg that hangs may have been put down where one stance is so much above the load.
PUT_DOWN: Final = 1.0
# Stances of a leg whose lifts are so far off say nothing.
STRANGE: Final = 2.5
# p is kept over so many ticks that cannot be judged.
KEPT_TICKS: Final = 5


@compiled
def forget_state(leg):
    """Reset the state to unknown when the source restarts; learned sizes stay."""
    leg.carried = leg.touches = False
    leg.pressed_n = leg.idle_n = leg.carried_n = 0
    leg.push_sum = leg.stance_push = leg.stance_most = 0.0
    leg.pressed_stances = 0
    leg.stance_n = -1
    leg.p = np.nan


@compiled
def hangs(leg):
    """Return whether no stance has shown load, so that nothing is reported after the turn.

    What such a leg does there is not known: a robot that hangs alarmed swing after swing, in a new
    gait even where a baseline knows its noise.  Of a leg with a baseline some push is enough.  Of
    one from a prior all legs of the robot decide, where they do (``standing.py``).
    """
    if not leg.has_lengths:
        return False
    if leg.from_prior:
        if leg.stands < 0 or (leg.hanging and not leg.carried):
            return not (leg.hanging and leg.after_known)
        return not (leg.carried or leg.stands > 0)
    return not leg.carried and leg.load < PUT_DOWN and (leg.hanging or not leg.after_known)


@compiled
def airborne(leg):
    """Return whether a leg that began with a prior hangs, so that all of its swing is learned."""
    return leg.from_prior and leg.hanging


@compiled
def update_load(leg):
    """Update the load by the push of a stance; decide by it whether the leg carries or hangs.

    A single push is no evidence, as a model that never learned the stance errs there; over some
    stances the sign of its mean parts the two.
    """
    if not leg.ticks or leg.after:
        inside = 0 <= leg.stance_n * leg.period_ns < STANCE_NS  # of a stance that began in sight
        if inside and leg.variance_scale <= STRANGE:
            leg.stance_n += 1
            leg.stance_push += leg.push_sum
            leg.stance_most = max(leg.stance_most, leg.push)
        return
    count, leg.stance_n = leg.stance_n, 0
    if count <= 0:
        return
    push, leg.stance_push = leg.stance_push / count, 0.0
    leg.pressed_stances = leg.pressed_stances + 1 if leg.stance_most > PRESSED_SUM else 0
    leg.stance_most = 0.0
    presses = leg.pressed_stances >= STANCES and leg.load > CARRIED_SHARE * leg.carried_load
    learned = airborne(leg)
    # In a motion that the model does not predict, a stance's push says less.
    put_down = leg.load + PUT_DOWN if leg.sure else max(leg.load + PUT_DOWN, leg.carries_push)
    if learned and leg.load_n == STANCES and push > put_down:
        leg.hanging, leg.load_n = False, 0  # what it learns from here on may carry
    leg.load_n = min(leg.load_n + 1, STANCES)
    leg.load += (push - leg.load) / leg.load_n
    enough = STANCES if leg.from_prior else LEAST_STANCES
    walks = leg.from_prior and leg.carried
    if walks:
        if leg.carried_n == 0 or push > CARRIED_SHARE * leg.carried_load:
            leg.carried_n = min(leg.carried_n + 1, CARRIED_STANCES)
            leg.carried_load += (push - leg.carried_load) / leg.carried_n
        if leg.load > min(leg.carries_push, CARRIED_SHARE * leg.carried_load):
            leg.idle_n = 0
        elif leg.load_n >= enough:
            leg.carried, leg.carried_n, walks = False, 0, False
    if leg.load_n >= enough and leg.load < leg.hangs_push and not walks:
        if leg.from_prior and not learned:
            leg.load_n = 0  # measured again, as its stances are learned from here on
        leg.hanging, leg.carried = True, False
    elif leg.load_n >= LEAST_STANCES and (leg.load > leg.carries_push or presses):
        leg.hanging, leg.carried, leg.idle_n = False, True, 0
        leg.slight = leg.load <= leg.carries_push
    elif leg.load > PUT_DOWN and not leg.from_prior:
        leg.hanging = False


@compiled
def sized(size, value, count, share):
    """Update a running quantile by one more value; ``share`` of the values lie below it."""
    if count == 1:
        return value
    step = 2.0 * (STEP if count > FULL_TICKS else count**-0.7)
    return size * math.exp(step * (share if value > size else share - 1.0))


@compiled
def set_sizes(leg, lever, whiten):
    """Set the sizes of free motion by a baseline's noise: medians of normal residuals.

    Args:
        leg: its scalars.
        lever: (J,) m/rad, height of the foot over each joint.
        whiten: (J, J) 1/rad, lower triangular; its diagonal alone, as joints correlate little.
    """
    variance = 0.0
    for j in range(len(lever)):
        variance += (lever[j] / whiten[j, j]) ** 2
    # Of a normal variable and of a chi-square with J degrees of freedom, J from 1 to 16.
    leg.push_size, leg.misfit_size = 0.67 * math.sqrt(variance), math.sqrt(len(lever) - 0.6)
    leg.high_ticks = GIVEN_TICKS


@compiled
def update_range(leg):
    """Update the range of commanded heights; return where the command is in it, from 0 to 1."""
    height = leg.command_m
    low = leg.lowest_command_m + (height - leg.lowest_command_m) * RANGE_LEAK
    high = leg.highest_command_m + (height - leg.highest_command_m) * RANGE_LEAK
    leg.lowest_command_m, leg.highest_command_m = min(low, height), max(high, height)
    way = leg.highest_command_m - leg.lowest_command_m
    return (height - leg.lowest_command_m) / way if way > LEAST_RANGE_M * leg.leg_size else 0.0


@stage
def update_state(leg, sample, swing, past, noise):
    """Update the state by a judged tick."""
    if not (leg.has_lengths and leg.has_model) or leg.misread or leg.cause or leg.rate_off:
        leg.p, leg.touches = np.nan, False
        return
    if leg.bad or not (leg.predicted or leg.foreseen):
        leg.kept_ticks += 1
        if leg.kept_ticks > KEPT_TICKS:
            leg.p, leg.touches = np.nan, False
        return
    leg.kept_ticks = 0
    joints = len(sample.measured)
    height_gradient(past.reading, swing.links, swing.axis_kinds, swing.lever)
    context = context_of(leg, sample.command, sample.before)
    push = square = arm = 0.0
    for r in range(joints):
        whitened = 0.0
        for c in range(joints):
            ahead = past.increment[c] if leg.predicted else past.ahead[c]
            off = past.window[c] - past.window[joints + c] - ahead
            whitened += noise.whiten[context, 0, r, c] * off
            if r == c:
                push += swing.lever[c] * off
                arm += abs(swing.lever[c])
        square += whitened * whitened
    share = update_range(leg)
    if not (leg.high_ticks or leg.from_prior):
        set_sizes(leg, swing.lever, noise.whiten[context, 0])
    if share > 0.5:
        leg.high_ticks += 1
        least = LEAST_QUANTA * leg.quantum * arm
        leg.push_size = max(sized(leg.push_size, abs(push), leg.high_ticks, 0.5), least)
        misfit = math.sqrt(square)
        leg.misfit_size = max(sized(leg.misfit_size, misfit, leg.high_ticks, 0.5), LEAST_QUANTA)
    if leg.high_ticks < (KNOWN_TICKS if leg.from_prior else GIVEN_TICKS):
        return
    if share < 0.5:
        leg.low_ticks += 1
        loaded = sized(leg.loaded_push, push, leg.low_ticks, LOADED_QUANTILE)
        leg.loaded_push = max(loaded, leg.push_size)
    over = max(1.0, leg.loaded_push / (LOADED_SIZES * leg.push_size))
    push = BOUND * math.tanh(push / (over * leg.push_size * BOUND))
    leg.push_sum = FORGETTING * leg.push_sum + push
    leg.misfit = math.log1p(square / (over * leg.misfit_size) ** 2)
    leg.command_odds = MOST_NATS * math.tanh(STEEPNESS * (EVEN_SHARE - share))
    update_load(leg)
    leg.pressed_n = leg.pressed_n + 1 if share < 0.5 and push > PRESSED else 0
    leg.idle_n += share < 0.5
    if leg.pressed_n * leg.period_ns >= PRESSED_NS:
        leg.carried, leg.idle_n = not leg.hanging, 0
    if not leg.carried or leg.idle_n * leg.period_ns > IDLE_NS:
        leg.carried = leg.touches = False
        leg.p = np.nan
        return
    if leg.slight:  # such a push parts no ticks
        leg.p, leg.touches = np.nan, False
        return
    odds = WEIGHTS[0] + WEIGHTS[1] * leg.push_sum + WEIGHTS[2] * leg.misfit + leg.command_odds
    leg.p = 1.0 / (1.0 + math.exp(-odds))
    leg.touches = leg.p > (leg.touches_below if leg.touches else leg.touches_above)
