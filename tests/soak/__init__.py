"""A long run: six walking legs for half an hour, with everything that happens to a robot.

``make soak MINUTES=30`` runs a router, the service and
the simulator as processes of their own, kills and restarts them on schedule while the legs drift,
and judges what came of it against the simulator's own recording.
"""
