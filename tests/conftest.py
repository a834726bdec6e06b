"""Shared fixtures. Every annotated shape is checked while the tests run (see pyproject)."""

import os
import signal
from pathlib import Path

from hypothesis import HealthCheck, settings

if os.name != "posix":  # what these are about is signals, process groups and pipes as POSIX has them
    collect_ignore = ["pipeline/test_workers.py", "reports", "test_stopping.py"]

# Tests that run `flx` as a user does compile the same programs in several processes: once is enough.
CACHE = Path(__file__).parent.parent / ".pytest_cache" / "jax"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

# What runs a few times only is best compiled fast. All processes alike: some tests compare their bits.
FAST = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FAST}"

settings.register_profile(
    "flx", deadline=None, derandomize=True, max_examples=20, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("flx")

# Under nohup, or in the background of a script, signals are ignored, also by commands that tests start.
for _name, _handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    _number = getattr(signal, _name, None)  # Windows has no SIGHUP
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)
