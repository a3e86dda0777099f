"""A long run: six walking legs for half an hour, with everything that happens to a robot.

``python -m adaptive_contact_sim.soak --minutes 30`` (``make soak``) runs a router, the service and
the simulator as processes of their own, kills and restarts them on schedule while the legs drift,
and judges what came of it against the simulator's own recording.
"""

from __future__ import annotations

from adaptive_contact_sim.soak.conduct import conduct
from adaptive_contact_sim.soak.plan import SoakPlan
from adaptive_contact_sim.soak.verdict import Verdict, judge

__all__ = ["SoakPlan", "Verdict", "conduct", "judge"]
