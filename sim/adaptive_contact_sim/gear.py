r"""Backlash: gears with a gap between motor and link.

A joint without backlash is one rigid body: rotor inertia, back-EMF and friction sit on the joint in
the engine.  With backlash :math:`b`, rotor and link become two masses.  The rotor,
:math:`(\theta_m, \omega_m)`, is integrated here; the teeth couple them only outside the backlash,

.. math:: \delta = \theta_m - \theta, \quad
          \tau_c = k\,[\delta - \operatorname{clip}(\delta, \pm b/2)] + d\,(\omega_m - \omega),

and never pull (the damping cannot turn the force around).  The potentiometer sits on the output
shaft, so the servo regulates the link and hunts inside the backlash, as worn servos do.

The rotor's step is semi-implicit: damping implicit, Coulomb friction solved exactly (a rotor
that friction can stop within the step stops).
"""

from __future__ import annotations

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact_sim.servo import ServoBank


class GearTrain:
    """The joints that have backlash, and their rotors.

    Args:
        servos: the servo bank; its damping, friction and armature are taken over for the joints
            with backlash, in the views of the engine that it has.
        armature: (S,) view of the engine's joint armatures, kg*m².
        period_s: physics step.
    """

    def __init__(self, servos: ServoBank, armature: Array, period_s: float) -> None:
        self._servos = servos
        self._armature = armature
        self._period_s = period_s
        self._index = np.zeros(0, dtype=np.intp)
        self._half_backlash = np.zeros(0)
        self.rotor_angle = np.zeros(0)
        self.rotor_velocity = np.zeros(0)

    @property
    def active(self) -> bool:
        """Whether any joint has backlash."""
        return bool(self._index.size)

    def set_backlash(self, backlash_rad: Array) -> bool:
        """Give the joints their backlash.

        Rotors that keep having backlash keep their state; new ones start in the middle of it, at
        the link's speed.

        Args:
            backlash_rad: (S,) total, 0 for none.

        Returns:
            Whether the set of joints with backlash changed, and with it the joints' armature.
        """
        index = np.flatnonzero(backlash_rad > 0.0)
        changed = not np.array_equal(index, self._index)
        if changed:
            angle = self._servos.position.copy()
            velocity = self._servos.velocity.copy()
            angle[self._index] = self.rotor_angle
            velocity[self._index] = self.rotor_velocity
            self.rotor_angle = angle[index]
            self.rotor_velocity = velocity[index]
            self._armature[self._index] = self._servos.parameters.armature_kgm2[self._index]
            self._armature[index] = 1e-4
            self._index = index
        self._half_backlash = backlash_rad[index] / 2.0
        self.refresh()
        return changed

    def refresh(self) -> None:
        """Take over the joints' damping, after the servos' condition changed."""
        self._servos.damping[:] = self._servos.back_emf + self._servos.viscous
        # Beyond the teeth: output gear and horn (assumed shares of the whole).
        self._servos.damping[self._index] = 0.001

    def step(self) -> None:
        """Advance the rotors by one physics step; replaces motor torque by the teeth's.

        To be called after the servos' ``drive`` and before the engine's step.
        """
        i, h = self._index, self._period_s
        servos = self._servos
        gap = self.rotor_angle - servos.position[i]
        bite = gap - np.clip(gap, -self._half_backlash, self._half_backlash)
        # Teeth: 1.5 N*m bends them by 0.6 degrees (assumed).  Link and rotor on this spring swing
        # at 470 rad/s at most (tibia), well inside what a 1 ms symplectic step follows.
        push = 150.0 * bite + 0.15 * (self.rotor_velocity - servos.velocity[i])
        teeth = np.where(
            bite > 0.0, np.maximum(push, 0.0), np.where(bite < 0.0, np.minimum(push, 0.0), 0.0)
        )

        inertia = servos.parameters.armature_kgm2[i]
        bound = servos.friction_bound(i, self.rotor_velocity, np.abs(teeth))
        effective = inertia + h * (servos.back_emf[i] + servos.viscous[i])
        free = (inertia * self.rotor_velocity + h * (servos.torque[i] - teeth)) / effective
        stopped = np.maximum(np.abs(free) - h * bound / effective, 0.0)
        self.rotor_velocity = np.copysign(stopped, free)
        self.rotor_angle = self.rotor_angle + h * self.rotor_velocity
        servos.torque[i] = teeth

    def rub(self) -> None:
        """Leave the joints with backlash only the friction beyond the teeth."""
        self._servos.friction[self._index] = 0.1 * self._servos.sliding[self._index]
