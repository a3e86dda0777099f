"""What passed while the service was down is counted, and who publishes is known after it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.core.detect.stream import MAX_OLD_RUNS, SHORT_RUN_SAMPLES, TAKE_BACK_SAMPLES
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.robot import parse_robot
from adaptive_contact.service.leg_endpoint import Downtime
from adaptive_contact.service.state.format import Position
from adaptive_contact.wire import Reject, ServoSample
from stepping import sample

USED = None
ROBOT = """
[robot]
name = "mini"
period_s = 0.02
quantum_rad = 0.005
[[leg]]
id = "rf"
joints = ["coxa", "femur"]
"""


class Admission:
    """A leg's place in a service that was last here where ``resumes`` says."""

    def __init__(self, resumes: Position | None = None) -> None:
        self.learner = ContactLearner(parse_robot(ROBOT, source="test"), "rf")
        self.downtime = Downtime(resumes)
        if resumes is not None:  # as from the snapshot that was saved with the position
            runs = {"run": resumes.run, "old_runs": list(resumes.superseded)}
            saved = {**self.learner.snapshot(), "stream": {"begun": True, **runs}}
            assert self.learner.restore(saved) is None

    def judge(self, one: ServoSample) -> Reject | None:
        self.learner.update(one)
        answer = self.learner.answer
        if isinstance(answer, Reject):
            return answer
        self.downtime.update(one, restart=answer.restart)
        return None

    @property
    def position(self) -> Position | None:
        return self.downtime.position(self.learner)


@given(
    st.lists(
        st.sampled_from([None, 1]), min_size=1, max_size=TAKE_BACK_SAMPLES - 1
    ),  # too few for anybody to be taken back: the count of those begins anew
    st.integers(0, TAKE_BACK_SAMPLES),
)
def test_publishers_are_told_apart_over_a_restart_as_without_one(
    runs: list[int | None], at: int
) -> None:
    whole, broken = Admission(), Admission()
    for k, run in enumerate(runs):
        if k == at:
            broken = Admission(broken.position)
        one = sample(k, run=run)
        assert broken.judge(one) == whole.judge(one)
    before, after = whole.position, broken.position
    assert after[:2] == before[:2]
    assert after.superseded == before.superseded


def test_publishers_remembered_are_bounded() -> None:
    admission = Admission(Position(0, 1))
    for run in range(1, 100):
        for seq in range(SHORT_RUN_SAMPLES):
            assert admission.judge(sample(seq, run=run)) == USED
    assert admission.position.superseded == tuple(range(99 - MAX_OLD_RUNS, 99))


def test_one_wild_number_after_a_restart_of_the_service_counts_nothing() -> None:
    admission = Admission(Position(1, 100))
    assert admission.judge(sample(0, seq=9_000_000, t_ns=1)) == USED
    told = [admission.judge(sample(k)) for k in range(200, 240)]
    assert told[-1] == USED
    # What passed until the source was believed; the samples refused meanwhile among it.
    assert admission.downtime.missed == told.index(USED) + 200 - 101
    assert admission.position == Position(1, 239, admission.downtime.missed)


def test_a_long_gap_over_a_restart_counts_though_the_service_is_killed_again_before() -> None:
    first = Admission(Position(1, 100))
    assert first.judge(sample(5000)) == USED
    assert first.downtime.before is not None
    again = Admission(first.position)
    told = [again.judge(sample(k)) for k in range(6000, 6010)]
    assert told == [USED] * 10
    assert again.downtime.before is None
    assert again.downtime.missed == 6000 - 101
