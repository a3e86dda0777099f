"""`doctor` against a table: each mistake by its name, and good robots with exit 0."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact.checks.findings import Cause
from adaptive_contact.checks.leg_ids import check_recorded_ids
from adaptive_contact.checks.legcheck import check_recording
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Mount, shipped_robot
from adaptive_contact.wire import ServoSample, servo_key
from adaptive_contact_sim import Simulation, SimulationSettings, WalkSettings
from quadruped import recorded

from . import mistakes as m
from .listening import alone, causes, listen

QUADRUPED = "quadruped"
ROBOT = shipped_robot()
BASELINE = shipped_baseline(ROBOT.name)
# Seconds that a source is followed: with a baseline, and until first models are learned.
SHORT_S, WHOLE_S = 8.0, 40.0


@pytest.fixture(scope="module")
def walk(walk_file: Path) -> list[m.Sent]:
    return m.first(m.read(walk_file), WHOLE_S)


@pytest.fixture(scope="module")
def trials() -> list[m.Sent]:
    samples, _ = recorded("free")
    return [m.Sent(servo_key(leg), s.t_ns, msgspec.to_builtins(s)) for leg, s in samples]


@pytest.mark.parametrize("given", [True, False], ids=["baseline", "cold start"])
@pytest.mark.parametrize("source", ["walk", "trials"])
def test_a_good_robot_has_no_findings(
    source: str, given: bool, request: pytest.FixtureRequest
) -> None:
    robot = shipped_robot(QUADRUPED) if source == "trials" else ROBOT
    baseline = shipped_baseline(robot.name) if given else None
    messages = m.last(request.getfixturevalue(source), SHORT_S if given else WHOLE_S)
    diagnosis = listen(messages, robot, baseline)
    assert diagnosis.exit_code == 0, diagnosis.findings


def test_a_robot_that_is_still_learning_is_no_good_one(walk: list[m.Sent]) -> None:
    diagnosis = listen(m.last(walk, SHORT_S), ROBOT, None)
    assert causes(diagnosis) == ["learning"]
    assert diagnosis.exit_code == 1


# Each mistake, and the one cause that is named.
TABLE: dict[str, tuple[m.Mistake, Cause]] = {
    "stamps with white jitter": (m.white_jitter, "jitter"),
    "stamps of a loop that takes turns": (m.turns_jitter, "jitter"),
    "ticks in bursts of five": (m.bursts(5), "jitter"),
    "stamps in float seconds": (m.float_seconds, "time_type"),
    "stamps in milliseconds": (m.milliseconds, "time_unit"),
    "a slower loop": (m.slower(1.25), "period"),
    "lost samples": (m.lossy(0.03), "loss"),
    "a run for every sample": (m.restarting, "run"),
    "two publishers": (m.doubled, "two_publishers"),
    "raw zeros": (m.raw_zeros(0.02), "glitches"),
    "zeros": (m.raw_zeros(0.02, 0.0), "glitches"),
    "the encoder's seam": (m.encoder_seam, "turn"),
    "a turn off": (m.one_turn_off, "turn"),
    "goals as readings": (m.echoed(), "echo"),
    "goals of the last tick as readings": (m.echoed(1), "echo"),
    "goals of five ticks ago": (m.echoed(5), "echo"),
    "goals with noise": (m.noisy_goals(0), "echo"),
    "late goals with noise": (m.noisy_goals(5), "echo"),
    "late goals, rounded": (m.compose(m.echoed(6), m.rounded(m.AX12_STEP)), "echo"),
    "readings held for two ticks": (m.held(2), "held"),
    "readings held for four ticks": (m.held(4), "held"),
    "legs read by turns": (m.held(6, by_turns=True), "held"),
    "one leg for all": (m.one_for_all, "twins"),
    "degrees": (m.degrees, "units"),
    "registers": (m.registers, "units"),
    "coarser steps": (m.rounded(0.02), "quantum"),
    "a frozen joint": (m.frozen(1), "frozen"),
    "a joint without torque": (m.without_torque(2), "frozen"),
    "another order of readings": (m.swapped_readings, "order"),
    "readings turned round": (m.turned_readings, "order"),
    "goals of the other sign": (m.goals_mirrored, "backwards"),
    "a wrong zero of readings": (m.zero_moved, "far"),
    "swing without end": (m.never_stance, "phase"),
    "an id in capitals": (m.renamed({"lf": "LF"}), "leg_ids"),
    "a misspelt key": (m.misspelt, "key"),
    "a joint too few": (m.angles(lambda row: row[:2]), "joints"),
    "stamps before 1970": (m.with_fields(t_ns=-5), "field"),
    "numbers below 0": (m.numbered(lambda seq: seq - 10**6), "field"),
    "a run beyond 64 bits": (m.with_fields(run=2**64 - 1), "field"),
    "valid of one joint": (m.with_fields(valid=[True]), "field"),
    "a preview of one joint": (m.with_fields(preview=[[0.1]]), "field"),
    "a preview that is not finite": (m.with_fields(preview=[[math.nan] * 3]), "field"),
    "numbers that count down": (m.numbered(lambda seq: 10**6 - seq), "seq"),
    "numbers of 7 bits": (m.numbered(lambda seq: seq % 128), "seq"),
    "numbers of 32 bits": (m.numbered(lambda seq: (seq - 1900) % 2**32), "seq"),
    "one number for all": (m.numbered(lambda _: 0), "seq"),
    "samples sent twice": (m.twice, "seq"),
    "samples out of order": (m.out_of_order, "seq"),
    "no goals": (m.with_fields(desired=[0.0, 0.0, 0.0]), "frozen"),
    "the same goals": (m.with_fields(desired=[0.0, 0.5, -1.9]), "frozen"),
    "a phase in capitals": (m.with_fields(phase="SWING"), "unreadable"),
    "NaN": (
        m.each_sample(
            lambda sent, rng: (
                sent.but(measured=[math.nan, *sent.body["measured"][1:]])
                if rng.random() < 0.05
                else sent
            )
        ),
        "not_finite",
    ),
}


@pytest.mark.parametrize(("mistake", "cause"), TABLE.values(), ids=TABLE.keys())
def test_a_mistake_has_one_entry_with_its_name(
    walk: list[m.Sent], mistake: m.Mistake, cause: Cause
) -> None:
    made = list(mistake(m.last(walk, SHORT_S), np.random.default_rng(1)))
    diagnosis = listen(made, ROBOT, BASELINE)
    assert causes(diagnosis) == [cause], diagnosis.findings
    assert diagnosis.exit_code == 1
    assert all(finding.remedy for finding in diagnosis.findings)


@pytest.mark.parametrize("given", [True, False], ids=["baseline", "cold start"])
@pytest.mark.parametrize("phase", [True, False], ids=["phase", "no phase"])
def test_pitch_that_grows_downwards_is_named(walk: list[m.Sent], phase: bool, given: bool) -> None:
    made = list(m.pitch_down(walk, np.random.default_rng(1)))
    if not phase:
        made = [m.Sent(s.key, s.at_ns, {**s.body, "phase": None}) for s in made]
    baseline = BASELINE if given else None
    diagnosis = listen(made, ROBOT, baseline)
    assert causes(diagnosis) == ["signs"], diagnosis.findings
    (finding,) = diagnosis.findings
    assert finding.legs == ["lf", "lm", "lr", "rf", "rm", "rr"]
    assert "directions = [1, -1, -1]" in finding.what
    assert diagnosis.exit_code == 1


def test_a_leg_that_a_cable_holds_while_it_walks(walk: list[m.Sent]) -> None:
    made = list(m.caught("rm", 4.0, 0.2)(walk, np.random.default_rng(1)))
    diagnosis = listen(made, ROBOT, BASELINE)
    assert causes(diagnosis) == ["ambiguous"], diagnosis.findings
    assert [finding.legs for finding in diagnosis.findings if finding.level == "error"] == [["rm"]]
    assert diagnosis.exit_code == 1


def test_all_legs_lost_at_once_point_to_the_description_first(walk: list[m.Sent]) -> None:
    made = list(m.late_goals(5)(walk, np.random.default_rng(1)))
    diagnosis = listen(made, ROBOT, BASELINE)
    assert causes(diagnosis)[0] == "not_this_robot", diagnosis.findings
    first = diagnosis.findings[0]
    # A leg of which more is known, by heights that are wrong as well, is named for itself.
    itself = {leg for one in diagnosis.findings[1:] if one.cause == "phase" for leg in one.legs}
    assert len(itself) <= 1
    assert sorted({*first.legs, *itself}) == sorted(ROBOT.leg_ids)
    places = [first.remedy.find(word) for word in ("signs", "zeros", "order of joints", "baseline")]
    assert -1 < places[0] < places[1] < places[2] < places[3]


def test_a_leg_that_its_baseline_lacks(walk: list[m.Sent]) -> None:
    legs = {leg: known for leg, known in BASELINE.legs.items() if leg != "lf"}
    given = dataclasses.replace(BASELINE, legs=legs)
    diagnosis = listen(m.last(walk, SHORT_S), ROBOT, given)
    (finding,) = diagnosis.findings
    assert (finding.level, finding.cause, finding.legs) == ("error", "learning", ["lf"])
    assert "of 10 swings" in finding.what


@pytest.mark.parametrize("period_s", [0.033, 0.01, 0.005], ids=["30 Hz", "100 Hz", "200 Hz"])
def test_a_good_robot_at_another_rate_has_no_findings(period_s: float) -> None:
    robot = msgspec.structs.replace(ROBOT, period_s=period_s)
    settings = SimulationSettings(motion=WalkSettings(), seed=3, period_s=period_s)
    sent = [
        m.Sent(servo_key(leg), sample.t_ns, msgspec.to_builtins(sample))
        for tick in Simulation(settings).run(12.0)
        for leg, sample in tick.samples.items()
    ]
    assert check_recording(robot, of_legs(sent), {}) == []
    # After so short a walk a leg is not known yet, and nothing else is wrong.
    diagnosis = listen(m.last(sent, 4.0), robot, None)
    assert causes(diagnosis, notes=True) == ["learning"], diagnosis.findings
    # By a robot.toml of another rate, it is named.
    wrong = listen(m.last(sent, 4.0), ROBOT, BASELINE)
    assert causes(wrong) == ["period"], wrong.findings


def test_two_joints_have_no_findings(walk: list[m.Sent]) -> None:
    two = list(m.angles(lambda row: row[1:])(walk, np.random.default_rng(1)))
    legs = tuple(
        msgspec.structs.replace(
            leg,
            joints=leg.joints[1:],
            axes=("pitch", "pitch"),
            lengths_m=None if leg.lengths_m is None else leg.lengths_m[1:],
            mount=Mount(),
            limits=None,
            servos=None,
        )
        for leg in ROBOT.legs
    )
    diagnosis = listen(two, msgspec.structs.replace(ROBOT, legs=legs), None)
    assert diagnosis.exit_code == 0, diagnosis.findings


@pytest.mark.parametrize(("periods", "named"), [(0.05, False), (0.12, False), (0.2, True)])
def test_jitter_of_a_loop_on_a_timer_is_none(
    walk: list[m.Sent], periods: float, named: bool
) -> None:
    made = of_legs(list(m.jitter(periods)(m.last(walk, SHORT_S), np.random.default_rng(1))))
    found = [finding.cause for finding in check_recording(ROBOT, made, {})]
    assert found == (["jitter"] if named else [])


def test_without_a_service_the_samples_tell_rate_and_steps(walk: list[m.Sent]) -> None:
    diagnosis = alone(m.last(walk, 4.0))
    assert causes(diagnosis, notes=True) == ["no_service", "undeclared"]
    note = diagnosis.findings[-1]
    assert note.what.endswith("samples come every 20.0 ms (50.0 Hz), readings step by 0.00512 rad")


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (m.white_jitter, "jitter"),
        (m.milliseconds, "time_unit"),
        (m.rounded(0.03), "quantum"),
        (m.degrees, "units"),
        (m.echoed(), "echo"),
        (m.one_for_all, "twins"),
    ],
    ids=["jitter", "milliseconds", "steps", "degrees", "echo", "twins"],
)
def test_without_a_service_mistakes_are_named_all_the_same(
    walk: list[m.Sent], mistake: m.Mistake, cause: Cause
) -> None:
    diagnosis = alone(list(mistake(m.last(walk, 4.0), np.random.default_rng(1))))
    assert sorted(causes(diagnosis)) == sorted(["no_service", cause]), diagnosis.findings


SWAPS: dict[str, dict[str, str]] = {
    "mirrored": {"lf": "rf", "rf": "lf"},
    "neighbours": {"lf": "lm", "lm": "lf"},
    "a circle": {"lf": "lm", "lm": "lr", "lr": "lf"},
    "half a turn": {"lf": "rr", "lm": "rm", "lr": "rf", "rf": "lr", "rm": "lm", "rr": "lf"},
}


@pytest.mark.parametrize("swap", SWAPS.values(), ids=SWAPS.keys())
def test_legs_under_each_others_ids_are_named(walk: list[m.Sent], swap: dict[str, str]) -> None:
    diagnosis = listen(list(m.renamed(swap)(walk, np.random.default_rng(1))), ROBOT, BASELINE)
    assert causes(diagnosis) == ["leg_swap"], diagnosis.findings
    assert diagnosis.exit_code == 1
    (finding,) = diagnosis.findings
    assert sorted(finding.legs) == sorted(swap)


def of_legs(messages: list[m.Sent]) -> dict[str, list[ServoSample]]:
    samples: dict[str, list[ServoSample]] = {}
    for sent in messages:
        if sent.is_sample:
            samples.setdefault(sent.leg, []).append(msgspec.convert(sent.body, ServoSample))
    return samples


def test_without_models_feet_that_stand_tell_ids(walk: list[m.Sent]) -> None:
    robot, samples = ROBOT, of_legs(m.last(walk, 20.0))
    assert check_recorded_ids(robot, samples) == {}
    for name, swap in SWAPS.items():
        swapped = {swap.get(leg, leg): rows for leg, rows in samples.items()}
        lines = check_recorded_ids(robot, swapped)
        # Turned by half a turn, this body looks the same.
        assert sorted(lines) == ([] if name == "half a turn" else sorted(swap)), name
        for leg, line in lines.items():
            owner = next(old for old, new in swap.items() if new == leg)
            assert f"the samples are those of leg '{owner}'" in line


def test_no_ids_are_told_without_mounts_nor_of_legs_that_hang_or_move_as_they_like(
    walk: list[m.Sent],
) -> None:
    samples = of_legs(m.last(walk, 20.0))
    swapped = {SWAPS["neighbours"].get(leg, leg): rows for leg, rows in samples.items()}
    bare = tuple(msgspec.structs.replace(leg, mount=Mount()) for leg in ROBOT.legs)
    assert check_recorded_ids(msgspec.structs.replace(ROBOT, legs=bare), swapped) == {}
    hung, wild = dict[str, list[ServoSample]](), dict[str, list[ServoSample]]()
    for number, (leg, rows) in enumerate(swapped.items()):
        steps = np.random.default_rng(number).normal(0.0, 0.01, (len(rows), 3))
        own = np.cumsum(steps, axis=0).tolist()
        hung[leg] = [msgspec.structs.replace(s, measured=s.desired) for s in rows]
        wild[leg] = [
            msgspec.structs.replace(s, measured=at, desired=at)
            for s, at in zip(rows, own, strict=True)
        ]
    assert check_recorded_ids(ROBOT, hung) == check_recorded_ids(ROBOT, wild) == {}


def yaw_turned(messages: list[m.Sent]) -> list[m.Sent]:
    flip, rng = m.angles(lambda row: [-row[0], *row[1:]]), np.random.default_rng(1)
    front = ("lf", "rf")
    return [
        one for sent in messages for one in (flip([sent], rng) if sent.leg in front else [sent])
    ]


def test_a_yaw_of_the_wrong_sign_is_no_swap_where_models_tell(walk: list[m.Sent]) -> None:
    diagnosis = listen(yaw_turned(walk), ROBOT, BASELINE)
    assert causes(diagnosis) == ["signs"], diagnosis.findings
    lines = check_recorded_ids(ROBOT, of_legs(yaw_turned(m.last(walk, 20.0))))
    assert sorted(lines) == ["lf", "rf"]
    assert all("as likely, the yaw angles grow the wrong way" in line for line in lines.values())
