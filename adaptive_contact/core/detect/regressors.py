"""Evaluates the regressors and the prediction of one leg, compiled.

A library's terms become a table that one loop evaluates: each term is a sparse linear form of the
flat window with a function over it, or a product of two entries.  A library with changes adds
friction and softness against the movement that the first model predicts.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.compiled import compiled
from adaptive_contact.model.library import CHANGE_KNEES_RAD_S, ChangeLibrary, Library

ONE: Final = 0
LINEAR: Final = 1
CLIP: Final = 2
TANH: Final = 3
COS: Final = 4
SIN: Final = 5
PRODUCT: Final = 6


class TermTable(NamedTuple):
    """Tabulates the terms of a library without changes, and where its changes come from."""

    kind: Ints  # (q,) function of each term
    first: Ints  # (q + 1,) where each term's entries begin
    entry: Ints  # (n,) places in the flat window
    weight: Array  # (n,) of each entry
    knee: Array  # (K,) rad, of friction against the predicted movement; none without changes
    # (2,) first and last + 1 of the terms of the control law; equal where unknown
    law: Ints


def term_table(library: Library) -> TermTable:
    """Tabulate a library's terms."""
    terms: list[tuple[int, list[tuple[int, float]]]] = []
    law = [0, 0]
    functions: dict[Any, int] = {np.tanh: TANH, np.cos: COS, np.sin: SIN}
    if library.name == "servo":
        shape = library._servo_shape
        size = shape.linear.shape[1]
        kinds = np.full(size, LINEAR)
        kinds[0] = ONE
        kinds[shape.clipped] = CLIP
        for columns, function in shape.curved:
            kinds[columns] = functions[function]
        for column, kind in enumerate(kinds.tolist()):
            places = np.flatnonzero(shape.linear[:, column]).tolist()
            terms.append((kind, [(i, float(shape.linear[i, column])) for i in places]))
        law = [shape.clipped.start, shape.clipped.stop]
    else:
        size = len(library._variable_names())
        terms.append((ONE, []))
        terms += [(LINEAR, [(i, 1.0)]) for i in range(size)]
        if library.name == "paper":
            terms += [(SIN, [(i, 1.0)]) for i in range(size)]
            terms += [(COS, [(i, 1.0)]) for i in range(size)]
            pairs = zip(*(of.tolist() for of in library._pairs), strict=True)
            terms += [(PRODUCT, [(i, 1.0), (j, 1.0)]) for i, j in pairs]
    knees = [knee * library.period_s for knee in CHANGE_KNEES_RAD_S]
    entries = [entry for _, of in terms for entry in of]
    changes = isinstance(library, ChangeLibrary)
    return TermTable(
        kind=np.array([kind for kind, _ in terms]),
        first=np.cumsum([0, *(len(of) for _, of in terms)]),
        entry=np.array([place for place, _ in entries], dtype=np.int64),
        weight=np.array([weight for _, weight in entries]),
        knee=np.array(knees if changes else []),
        law=np.array(law),
    )


@compiled
def regressors(window, kind, first, entry, weight, knee, law, xi0, theta, room):
    """Fill (p,) theta from a flat (w,) window, by a :class:`TermTable`.

    ``xi0`` is (q, J), the first model's coefficients of the terms without changes; ``room`` is
    (2 J,) scratch.
    """
    terms, joints = len(kind), len(room) // 2
    at = terms
    for j in range(2 * joints):
        room[j] = 0.0
    changes = len(knee) > 0
    for term in range(terms):
        what = kind[term]
        if what == PRODUCT:
            value = window[entry[first[term]]] * window[entry[first[term] + 1]]
        else:
            value = 0.0
            for k in range(first[term], first[term + 1]):
                value += weight[k] * window[entry[k]]
            if what == CLIP:
                raw = value
                value = min(max(value, -1.0), 1.0)
                if changes and law[0] <= term < law[1]:
                    change = min(max(0.5 * raw, -1.0), 1.0) - value
                    if change != 0.0:
                        for j in range(joints):
                            room[joints + j] += change * xi0[term, j]
            elif what == ONE:
                value = 1.0
            elif what == TANH:
                value = math.tanh(value)
            elif what == COS:
                value = math.cos(value)
            elif what == SIN:
                value = math.sin(value)
        theta[term] = value
        if changes and value != 0.0:
            for j in range(joints):
                room[j] += value * xi0[term, j]
    if not changes:
        return
    for k in range(len(knee)):
        for j in range(joints):
            theta[at] = math.tanh(room[j] / knee[k])
            at += 1
    if law[0] < law[1]:
        for j in range(joints):
            theta[at] = room[joints + j]
            at += 1


@compiled
def predict(theta, coefficients, increment):
    """Fill the (J,) predicted increment; True if it is finite."""
    increment[:] = 0.0
    joints = len(increment)
    for term in range(len(theta)):
        value = theta[term]
        for j in range(joints):
            increment[j] += value * coefficients[term, j]
    total = 0.0
    for j in range(joints):
        total += increment[j]
    return math.isfinite(total)
