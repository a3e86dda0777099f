from __future__ import annotations

import math

import numpy as np
import pytest

from adaptive_contact_sim.encoder import Encoder, EncoderSettings
from adaptive_contact_sim.servo import QUANTUM_RAD


def readings(settings: EncoderSettings, ticks: int = 4000, seed: int = 0):
    encoder = Encoder(settings, np.random.default_rng(seed))
    # Triangles of 1.3 steps per tick, so that a stale reading shows.
    ramp = 1.3 * QUANTUM_RAD * np.abs((np.arange(ticks) % 400) - 200)
    truth = ramp[:, None] + np.linspace(0.0, 0.1, 18)
    read = [encoder.read(row) for row in truth]
    return truth, np.array([r.angle_rad for r in read]), np.array([r.valid for r in read])


def test_readings_are_whole_steps_with_half_a_step_of_noise() -> None:
    truth, read, valid = readings(EncoderSettings())
    steps = read / QUANTUM_RAD
    assert np.allclose(steps, np.rint(steps))
    # Noise of half a step and rounding, which adds a twelfth of a squared step.
    assert (read - truth).std() / QUANTUM_RAD == pytest.approx(math.sqrt(0.25 + 1 / 12), rel=0.02)
    assert abs((read - truth).mean()) < 0.01 * QUANTUM_RAD
    assert valid.all()


def test_without_noise_it_rounds() -> None:
    truth, read, _ = readings(EncoderSettings(noise_steps=0.0))
    assert np.abs(read - truth).max() <= QUANTUM_RAD / 2 + 1e-12


def test_faults_come_as_often_as_asked() -> None:
    truth, read, valid = readings(
        EncoderSettings(noise_steps=0.0, dropped=0.03, repeated=0.05, bogus=0.02)
    )
    assert (~valid).mean() == pytest.approx(0.03, rel=0.1)
    bogus = read == -math.pi
    assert bogus.mean() == pytest.approx(0.02 * 0.97 * 0.95, rel=0.1)
    assert valid[bogus].all()  # nobody knows that it is wrong
    stale = (np.abs(read - truth) > QUANTUM_RAD * 0.6) & ~bogus
    # Dropped ones are stale too.
    assert stale.mean() == pytest.approx(0.03 + 0.97 * 0.05, rel=0.1)
    # What is dropped repeats the last true reading, never a bogus one.
    lost = ~valid[1:]
    assert (read[1:][lost] != -math.pi).all()


def test_faults_do_not_shift_the_noise() -> None:
    _, clean, _ = readings(EncoderSettings())
    _, faulty, valid = readings(EncoderSettings(dropped=0.01))
    assert np.array_equal(clean[valid], faulty[valid])
