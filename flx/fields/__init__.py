"""The equations of the paper: pure JAX functions without parameters.

    import jax

    import flx
    from flx import fields

    tables = flx.mesh_tables(flx.Triangulation(vertices, faces))  # your own mesh, as it is
    x = fields.tangent_noise(jax.random.key(0), (len(vertices), 4))  # 4 tangent vectors at each vertex
    bank = fields.init_filter(jax.random.key(1), channels=4, features=8)
    y = fields.field_conv(tables.fine, x, bank)

All take a mesh as its gather tables, commute with a change of frame, and work under `jit`, `grad` and `vmap`.
"""

from flx.fields.algebra import (
    complex_linear,
    inner,
    squared_modulus,
    tangent_noise,
    unit,
    vn_nonlinearity,
)
from flx.fields.convolution import field_conv, init_filter, pool, unpool
from flx.fields.diffusion import diffuse, linear_schedule
from flx.fields.samplers import ancestral, ddim, dpm_solver, reverse

__all__ = [
    "ancestral",
    "complex_linear",
    "ddim",
    "diffuse",
    "dpm_solver",
    "field_conv",
    "init_filter",
    "inner",
    "linear_schedule",
    "pool",
    "reverse",
    "squared_modulus",
    "tangent_noise",
    "unit",
    "unpool",
    "vn_nonlinearity",
]
