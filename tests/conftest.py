"""Makes the helpers of this folder (`analytic`) importable from every test, and every property test repeatable."""

import os
import signal

from hypothesis import settings

# A shell starts its background commands with SIGINT ignored; tests of interrupts need the usual handler.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Parallel tests use one core each: torch and OpenBLAS read this when they are imported, as do the commands under test.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# The same examples on every run and machine; a slow machine is no failure.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
