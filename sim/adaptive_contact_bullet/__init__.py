"""Robots in another physics engine (Bullet), with servos of another make.

No figure of detection may rest on one engine, one servo law and one set of gaits.  What is here
shares none of them with :mod:`adaptive_contact_sim`: nothing of the product was tuned to it, and
only the studies use it (extra ``bullet``).

``robots`` → ``plant`` (Bullet) with ``servo`` → ``gait`` → ``record``, which also makes the twins.
"""
