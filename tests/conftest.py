"""For all tests."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

from adaptive_contact.service.refit_process import ONE_BLAS_THREAD

# Of this process and of those that tests start; BLAS reads it when it is loaded.  A leg's matrices
# gain nothing from threads, and threads that wait for each other spin: on a core that another
# process has, a QR factorisation of 600 rows takes 0.4 s instead of 1 ms.
os.environ.update(ONE_BLAS_THREAD)

# Machines are shared: how long an example takes to draw or to run there says nothing of the code.
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")
