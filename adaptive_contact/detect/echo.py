"""Follows two faults of a source, compiled: copies of commands, swapped phases.

The reasons and the evidence stand in ``source_watch.py``.  An echo's runs are
(J, lags, 5): lowest and highest error, slowest and fastest step of the command, all in position
steps, and ticks in which the command moved, below zero where there is no run.  Parts, swings and
stances, are (3, 4): ticks, travel, the furthest fall and the peak of the commanded foot; the part
in hand first, then the last stance and the last swing.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from adaptive_contact.compiled import compiled
from adaptive_contact.detect.swing import UNKNOWN

# A copy may be of the command of so many ticks before.
ECHO_TICKS: Final = 3
# Rounding to a grid, down, up or to the nearest step, leaves an echo within an interval of one
# step.  Less than one, so that of commands that lie on the grid nothing but equality is left.
ECHO_WIDTH: Final = 0.998
# A command moves in a tick when it goes further than this, in steps.
MOVED: Final = 0.5
# A run of so many moved ticks, over such a range of speeds (steps a tick), of so much evidence, is
# an echo.  Of 4,537 simulated swings the longest run of a servo over a range of 8 has 6 such
# ticks; real servos have 5 over 3.5, or hundreds at one speed, over 0.4 (decision 24).
LEAST_MOVED: Final = 10
LEAST_RANGE: Final = 3.0
ECHO_EVIDENCE: Final = 90.0
# With so much evidence it is likely enough not to learn from a lift: at the top of a free one, runs
# of servos have none.
SUSPECT_MOVED: Final = 3
SUSPECT_EVIDENCE: Final = 20.0
# It has ended after so many ticks in a row that match no command.
ECHO_OVER: Final = 3

# Mean speed of a swing's command over that of the stance beside it: 1.28 and more of correct
# phases, at most 0.61 of swapped ones (decision 24).
SWAPPED_RATIO: Final = 0.8
# And the foot's command comes down by less than this share of what it does in stances: by 18 mm and
# more in a swing that meets the ground, by 5 mm at most in 95 of 100 stances.
FALL_SHARE: Final = 0.5
# It comes down in stances by this much, as in any swing.
LEAST_FALL_M: Final = 0.01
# Without geometry the speed alone must say so, in so many swings in a row: a leg that is put
# somewhere else in its stance may be fast, too.
SLOW_SWINGS: Final = 2
# Parts of fewer ticks have no mean speed worth comparing, nor has the beginning of one.
LEAST_TICKS: Final = 3
BEGINNING: Final = 8

LAGS: Final = ECHO_TICKS + 1
COMMANDS: Final = ECHO_TICKS + 2  # one more than is compared, as steps are between two
NONE: Final = 0  # causes
ECHO: Final = 1
PHASE: Final = 2
TICKS: Final = 0  # of a part
TRAVEL: Final = 1
FALL: Final = 2
PEAK: Final = 3


@compiled
def begin_echo(runs):
    """Restart the counts: a swing begins, or what comes does not connect."""
    runs[:, :, 4] = -1.0


@compiled
def take_command(leg, desired, commands):
    """Take in a sample's command, before its readings."""
    for lag in range(COMMANDS - 1, 0, -1):
        commands[lag] = commands[lag - 1]
    for j in range(len(desired)):
        commands[0, j] = desired[j]
    leg.echo_n = min(leg.echo_n + 1, COMMANDS)


@compiled
def take_readings(
    leg, measured, valid, has_valid, step_rad, most_rad, commands, runs, off, echoing
):
    """Compare readings with the commands up to their own."""
    leg.suspected = False
    for j in range(len(measured)):
        if not (has_valid and not valid[j]):
            matched = False
            for lag in range(leg.echo_n - 1):
                error = measured[j] - commands[lag, j]
                run = runs[j, lag]
                if abs(error) > most_rad:
                    run[4] = -1.0
                    continue
                matched = True
                step = (commands[lag, j] - commands[lag + 1, j]) / step_rad
                error /= step_rad
                low, high = min(run[0], error), max(run[1], error)
                if run[4] < 0.0 or high - low > ECHO_WIDTH:
                    run[0] = run[1] = error
                    run[2], run[3], run[4] = np.inf, -np.inf, 0.0
                    continue
                run[0], run[1] = low, high
                run[2], run[3] = min(run[2], step), max(run[3], step)
                run[4] += abs(step) > MOVED
                width = run[3] - run[2]
                if run[4] >= LEAST_MOVED and width >= LEAST_RANGE:
                    echoing[j] |= run[4] * width >= ECHO_EVIDENCE
            leg.echoes = echoing.any()
            if leg.echoes:
                off[j] = 0 if matched else off[j] + 1
                if off[j] >= ECHO_OVER:
                    echoing[j] = False
        for lag in range(LAGS):
            moved = runs[j, lag, 4]
            if moved >= SUSPECT_MOVED:
                leg.suspected |= moved * (runs[j, lag, 3] - runs[j, lag, 2]) >= SUSPECT_EVIDENCE
    leg.echoes = echoing.any()


@compiled
def restart_phase(leg, parts):
    """Forget the parts of swings: what comes does not connect to what was."""
    leg.has_before = False
    leg.phase_part = UNKNOWN
    leg.part_whole = False
    leg.slow_swings = 0
    parts[1:, TICKS] = 0.0


@compiled
def speed_of(part):
    """Compute the mean speed of a part's command, rad per tick."""
    return part[TRAVEL] / max(part[TICKS], 1.0)


@compiled
def compare_parts(leg, parts, swing, ended):
    """Compare the mean speed of the present part with that of the one beside it."""
    beside = 1 if swing else 2
    if parts[beside, TICKS] == 0.0:
        return
    in_swing, in_stance = (0, beside) if swing else (beside, 0)
    fast, slow = speed_of(parts[in_swing]), speed_of(parts[in_stance])
    if leg.swapped:
        # Of a swing in hand: what is published as a stance begins slowly, too.
        if swing and slow < SWAPPED_RATIO * fast:
            leg.swapped = False
        return
    slower = fast < SWAPPED_RATIO * slow
    if ended:
        leg.slow_swings = leg.slow_swings + 1 if slower else 0
    if slower and not leg.has_lengths:
        leg.swapped = leg.slow_swings >= SLOW_SWINGS
    elif slower and (ended or not swing):
        fall = parts[in_stance, FALL]
        leg.swapped = fall > LEAST_FALL_M * leg.size and parts[in_swing, FALL] <= FALL_SHARE * fall


@compiled
def take_phase(leg, phase, desired, height, before, parts):
    """Take in the phase that a sample states, its command, and the commanded foot's height in m."""
    if phase == UNKNOWN:
        if leg.phase_part != UNKNOWN:
            restart_phase(leg, parts)
            leg.swapped = False
        return
    if phase != leg.phase_part:
        over = leg.phase_part
        if over != UNKNOWN:
            if leg.part_whole and parts[0, TICKS] >= LEAST_TICKS:
                if over == 1:
                    compare_parts(leg, parts, True, True)
                parts[1 + over] = parts[0]
            leg.part_whole = True
        leg.phase_part = phase
        parts[0, TICKS] = parts[0, TRAVEL] = parts[0, FALL] = 0.0
        parts[0, PEAK] = -np.inf
    part = parts[0]
    if leg.has_before:
        for j in range(len(desired)):
            part[TRAVEL] += abs(desired[j] - before[j])
    leg.has_before = True
    for j in range(len(desired)):
        before[j] = desired[j]
    part[TICKS] += 1.0
    part[PEAK] = max(part[PEAK], height)
    part[FALL] = max(part[FALL], part[PEAK] - height)
    if leg.part_whole and part[TICKS] >= BEGINNING:
        compare_parts(leg, parts, phase == 1, False)
