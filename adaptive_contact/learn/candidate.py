"""Compares sparse refits with the active model on new ticks, and promotes or refuses them."""

from __future__ import annotations

import math
import zlib
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.fit.refit_job import RefitJob, RefitResult, Refitter
from adaptive_contact.fit.sparse_regression import FitStatus
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.learn.rls import is_plausible
from adaptive_contact.learn.state import ImplausibleError, array_of, pack
from adaptive_contact.model.bounds import is_count
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.glr import statistic
from adaptive_contact.model.labelled_swing import Row, Touch
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.training_domain import Domain
from adaptive_contact.wire import RefitCounts

# Contacts stored: as many as a minute of walking brings, half of them of the ground.
MOST_CONTACTS: Final = 40
REFIT_EVERY_SWINGS: Final = 20
# Or after so long, for legs that step slowly.
REFIT_EVERY_S: Final = 30.0
# The first comes later by up to this share of that, for each leg its own: the fits of legs that
# walk together, one process's work, do not all fall into one step.
SPREAD: Final = 0.5
# Ticks after its snapshot at which a result takes effect, so that a replay, which waits for it,
# gives the same events as the live run, which does not.
REFIT_DUE_TICKS: Final = 50
# A minute of one gait does not span the workspace, and the ends of descents are never learned: a
# refit holds on to the model in force with the weight of so many rows per term, and of so many
# from wherever the model has been.
PRIOR_ROWS: Final = 20.0
DOMAIN_ROWS: Final = 1000.0
MIN_ROWS_PER_TERM: Final = 4
# New ticks on which the candidate and the active model are compared, the latter before it learns
# them.
TRIAL_ROWS: Final = 200
# And the contacts that there have to be: free ticks say nothing of what it would make of a touch.
# Until they have come a trial goes on, over the newest ticks.  They are stored while the leg is
# known; one whose model is wrong does not wait for them.
TRIAL_CONTACTS: Final = 3
# One that waits is looked at again after so many rows; a newer refit takes its place.
LOOK_AGAIN_ROWS: Final = 10
# The candidate must be better by so many standard errors of the paired difference.
PROMOTE_ERRORS: Final = 3.0
# Of the stored contacts that the active model finds, it may miss this share.
MISSED_SHARE: Final = 0.05
# A model that was displaced stands by for so many ticks, and comes back where it does better.
PROBATION_ROWS: Final = 100
# Share of the buffer that is fitted to, and room for segments of an older state of the leg.
FITTED_SHARE: Final = 0.8
ROOM: Final = 1.3


def rows_for_refit(model: LegModel) -> int:
    """Compute how many rows a buffer must hold for refits of a model's library."""
    return math.ceil(ROOM * MIN_ROWS_PER_TERM * model.library.size / FITTED_SHARE)


def first_refit_after(leg: str) -> tuple[int, float]:
    """Compute after how many swings, or s, a leg's first refit is asked for."""
    later = 1.0 + SPREAD * zlib.crc32(leg.encode()) / 2**32
    return round(later * REFIT_EVERY_SWINGS), later * REFIT_EVERY_S


class StoredContacts:
    """Stores the newest contacts of one leg in its present era, to try new models on.

    A sparse refit is chosen on free ticks, which say nothing about what it would make of a touch:
    one that explains how legs stop on the ground would win there, and detect no contact.
    """

    def __init__(self) -> None:
        self._kept: deque[Touch] = deque(maxlen=MOST_CONTACTS)

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, ticks: Touch) -> None:
        """Store a contact, the ticks from its alarm on; the oldest goes if there are too many."""
        self._kept.append(ticks)

    def clear(self) -> None:
        """Drop all, as the leg has changed: they may have been the change."""
        self._kept.clear()

    def found(self, coefficients: Array) -> Mask:
        """Return which of the stored contacts a model would report.

        In any of their ticks: an alarm that came too early, which a better model would not raise,
        is followed by the touch itself.

        Args:
            coefficients: (p, J).

        Returns:
            (n,), oldest first.
        """
        if not self._kept:
            return np.zeros(0, dtype=np.bool_)
        theta, target, whiten, limits, usable = map(np.concatenate, zip(*self._kept, strict=True))
        increment = theta @ coefficients
        said = statistic(target - increment, increment, whiten, usable)
        alarm = (np.nan_to_num(said.value) / limits).max(axis=-1) > 1.0
        begins = np.cumsum([0, *(len(contact.usable) for contact in self._kept)])[:-1]
        return np.asarray(np.logical_or.reduceat(alarm, begins))


class Candidate:
    """Requests and tries the refits of one leg.

    Args:
        leg: its id.
        noise: (J,) rad.
        scale: (p,) typical size of each regressor.
        refitter: does the work.
        domain: where the baseline's model has been; None if that is not known.
        most_rad: that a term of a plausible model moves a typical tick by; another is refused
            untried.

    Attributes:
        domain: where the leg has been: the baseline's, widened by the newest refit.
        contacts: that a candidate must find as well as the model in force does.
    """

    def __init__(
        self,
        leg: str,
        noise: Array,
        scale: Array,
        refitter: Refitter,
        domain: Domain | None = None,
        most_rad: float = math.inf,
    ) -> None:
        self._most_rad = most_rad
        self.domain = self._of_baseline = domain
        self.contacts = StoredContacts()
        self._leg = leg
        self._noise = noise
        self._scale = scale
        self._refitter = refitter
        self._swings = self._ticks = 0  # since the last refit was asked for
        self._every_swings, self._every_s = first_refit_after(leg)
        self._early = False
        self._retries = 0  # after a change, for a refit whose process was lost
        self._jobs = 0
        self._pending: int | None = None  # job
        self._candidate: Array | None = None
        self._probation = False  # the candidate is the active model of before
        # How far the active model (over the noise) and candidate were off in the rows of its trial.
        self._off: deque[tuple[Sequence[float], Array]] = deque(maxlen=TRIAL_ROWS)
        self._counts = dict.fromkeys(("promoted", "refused", "rolled_back"), 0)
        self._reason: str | None = None
        self._wait: str | None = None
        self._again = 0  # rows until a candidate that waits for contacts is looked at again

    @property
    def counts(self) -> RefitCounts:
        """Counts of refits, for the status."""
        reasons = "; ".join(filter(None, (self._reason, self._wait))) or None
        return RefitCounts(**self._counts, last_reason=reasons)

    def swing_done(self, period_s: float, *, learned: bool = True) -> bool:
        """Count a swing; return whether it is time to :meth:`request` a refit.

        Args:
            period_s: control tick.
            learned: some of its ticks were confirmed.
        """
        self._swings += learned
        if self._pending is not None or (self.trying and not self._again):
            return False
        waited_s = self._ticks * period_s
        return self._swings >= self._every_swings or waited_s >= self._every_s or self._early

    def request(self, model: LegModel, buffer: ReplayBuffer, era: int) -> None:
        """Request a refit if there is enough to fit to.

        Args:
            model: in force.
            buffer: confirmed segments.
            era: the present state of the leg.
        """
        waits = self.trying  # for contacts
        p, joints = model.coefficients.shape
        fit, held_out = buffer.factors(p, joints, era=era)
        if fit.rows < MIN_ROWS_PER_TERM * p:
            if waits:
                return
            self._wait = (
                f"waiting: {fit.rows:.0f} free ticks of the leg as it is to fit to, "
                f"{MIN_ROWS_PER_TERM * p} are needed"
            )
            return
        self._swings = self._ticks = 0
        self._every_swings, self._every_s = REFIT_EVERY_SWINGS, REFIT_EVERY_S
        self._early = False
        if not waits:
            self._wait = None
        self._jobs += 1
        prior = self._prior(model)
        self._refitter.submit(
            RefitJob(self._leg, self._jobs, fit, held_out, self._noise, prior, self._of_baseline)
        )
        self._pending = self._jobs

    def tick(self) -> bool:
        """Collect a result that is due; True if one came."""
        self._ticks += 1
        if self._pending is None or self._ticks <= REFIT_DUE_TICKS:
            return False
        result = self._refitter.collect(self._leg, self._pending)
        if result is None:
            return False
        self._take(result)
        return True

    def _take(self, result: object) -> None:
        """Try a refit's result, or refuse it."""
        self._pending = None
        assert isinstance(result, RefitResult)
        if result.status is not FitStatus.OK:
            self._refuse(f"the fit ended with '{result.status}'")
            if result.status is FitStatus.LOST and self._retries:
                self._retries, self._early = self._retries - 1, True
            return
        if not is_plausible(result.coefficients, self._scale, self._most_rad):
            self._refuse("a coefficient is not finite, or implausible")
            return
        self.domain, self._wait = result.domain, None
        self._try(result.coefficients, probation=False)

    @property
    def trying(self) -> bool:
        """Whether a candidate is on trial, for :meth:`compare`."""
        return self._candidate is not None

    @property
    def deciding(self) -> bool:
        """Whether the next row can decide a trial."""
        full = len(self._off) + 1 >= (PROBATION_ROWS if self._probation else TRIAL_ROWS)
        return full and self._again <= 1

    def compare(
        self, row: Row, off: Sequence[float], model: LegModel, *, valid: bool = True
    ) -> LegModel | None:
        """Compare the candidate on a new row; return it as the new model if it has won.

        Args:
            row: of a confirmed tick.
            off: (J,) how far the model in force was off there, over the noise.
            model: in force; used only if :attr:`deciding`.
            valid: the lifts fit the model in force: then its contacts are, or will be, stored, and
                a candidate waits until there are some to try it on.
        """
        if self._candidate is None:
            return None
        decided = self.deciding
        self._off.append((off, row.target - row.theta @ self._candidate))
        if not decided:
            self._again = max(self._again - 1, 0)
            return None
        of_active = np.square([off for off, _ in self._off])
        of_candidate = np.square(np.array([off for _, off in self._off]) / self._noise)
        # One wild reading must not decide.
        gain = (np.minimum(of_active, 25.0) - np.minimum(of_candidate, 25.0)).mean(axis=1)
        mean = float(gain.mean())
        errors = mean / max(float(gain.std()) / len(gain) ** 0.5, 1e-12)
        better = errors >= PROMOTE_ERRORS  # NaN is not
        words = f"{mean:+.3f} noise variances better ({errors:+.1f} standard errors) on new ticks"
        untried = valid and not self._probation and len(self.contacts) < TRIAL_CONTACTS
        if better and untried:
            self._wait = (
                f"waiting: a candidate is {words}, and there are {len(self.contacts)} contacts to "
                f"try it on, {TRIAL_CONTACTS} are needed"
            )
            self._again = LOOK_AGAIN_ROWS
            return None
        coefficients, self._candidate, self._wait = self._candidate, None, None
        self._again = 0
        if self._probation:
            self._probation = False
            if not better:
                return None
            self.rolled_back(f"the model before is {words}")
            return model.moved(coefficients, model.version + 1)
        if not better:
            self._refuse(words)
            return None
        found = self.contacts.found(model.coefficients)
        missed = int((found & ~self.contacts.found(coefficients)).sum())
        if missed > MISSED_SHARE * found.sum():
            self._refuse(f"{words}, but misses {missed} of {found.sum()} stored contacts")
            return None
        self._pending = None  # a newer refit that was to take its place
        self._counts["promoted"] += 1
        self._reason = f"promoted: {words}"
        self._try(model.coefficients, probation=True)
        return model.moved(coefficients, model.version + 1)

    def withdraw(self) -> None:
        """Drop refit and candidate, as the leg has changed; a new fit does not wait."""
        self._pending, self._candidate, self._probation = None, None, False
        self._early, self._retries, self._wait, self._again = True, 1, None, 0
        self.domain = self._of_baseline
        self.contacts.clear()

    def resume(self, buffer: ReplayBuffer, terms: int, era: int) -> None:
        """Widen the training domain by a restored buffer."""
        if self._of_baseline is not None:
            fit, _ = buffer.factors(terms, len(self._noise), era=era)
            self.domain = self._of_baseline.widened(fit)

    def rolled_back(self, why: str) -> None:
        """Count a return to an earlier model."""
        self._counts["rolled_back"] += 1
        self._reason = f"rolled back: {why}"

    def snapshot(self) -> dict[str, object]:
        """Return the counts, and the replaced model while it is on probation."""
        displaced = self._candidate if self._probation else None
        return {
            **self._counts,
            "reason": self._reason,
            "displaced": None if displaced is None else pack(displaced),
        }

    def restore(self, saved: object) -> None:
        """Take over what was saved; what does not fit is left out."""
        if not isinstance(saved, dict):
            return
        for name in self._counts:
            if is_count(saved.get(name)):
                self._counts[name] = saved[name]
        reason = saved.get("reason")
        self._reason = reason if isinstance(reason, str) else None
        shape = (len(self._scale), len(self._noise))
        try:
            displaced = array_of(saved.get("displaced"), shape, "the model before")
        except ImplausibleError:  # there was none
            return
        if is_plausible(displaced, self._scale, self._most_rad):
            self._try(displaced, probation=True)

    def _try(self, coefficients: Array, *, probation: bool) -> None:
        """Begin to compare coefficients with the model in force."""
        self._candidate, self._probation = coefficients, probation
        self._again = 0
        self._off.clear()

    def _prior(self, model: LegModel) -> Factor:
        """Make the rows that hold a refit to the model in force, as far as that was known."""
        prior = Factor(*model.coefficients.shape)

        def hold_on(theta: Array, stands_for: float) -> None:
            # Spread over the rows there are: λ and the ridge are per row that they stand for.
            size = (len(theta) / stands_for) ** 0.5
            weight = np.full(len(theta), size**-2)
            prior.add(size * theta, size * theta @ model.coefficients, weight)

        hold_on(np.diag(self._scale * PRIOR_ROWS**0.5), PRIOR_ROWS)
        if self.domain is not None and self.domain.rows > 0.0:
            hold_on(self.domain.rows_like(DOMAIN_ROWS), min(DOMAIN_ROWS, self.domain.rows))
        return prior

    def _refuse(self, why: str) -> None:
        """Count a refit that is not put in force, and keep the reason."""
        self._counts["refused"] += 1
        self._reason = f"refused: {why}"
