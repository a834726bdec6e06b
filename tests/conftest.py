"""Shared fixtures. Every annotated shape is checked while the tests run (see pyproject)."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "flx", deadline=None, derandomize=True, max_examples=20, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("flx")
