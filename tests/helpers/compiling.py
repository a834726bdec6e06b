"""Programs that run a few times only: compiling them fast saves more than running them fast."""

import functools

import jax

compiled = functools.partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
)
