"""Makes the helpers of this folder (`analytic`) importable from every test, and every property test repeatable."""

from hypothesis import settings

# The same examples on every run and machine; a slow machine is no failure.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
