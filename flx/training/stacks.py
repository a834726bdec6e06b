"""The parameters of a network as a few large arrays, which is how they are trained.

A network has more than a hundred parameters. For an optimiser that visits each of them, XLA compiles a
thousand small programs: half of what a step took to compile.
"""

import math
from collections import defaultdict
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

Stacks = dict[str, Float[Any, "..."]]  # by JAX or NumPy

MATRICES = ("kernel", "output")  # names of parameters [..., inputs, outputs]: of a layer, of a filter bank


def stacked(params: Any, matrices: bool) -> Stacks:
    """All parameters as one row; with `matrices`, those of one shape as a stack [N, inputs, outputs] instead.

    Layers of a scan and (re, im) are matrices of their own.
    """
    kernels, rest = defaultdict(list), []
    for path, leaf in jax.tree.leaves_with_path(params):
        if matrices and _is_matrix(path):
            kernels[_shape_name(leaf)].append(leaf.reshape(-1, *leaf.shape[-2:]))
        else:
            rest.append(leaf.reshape(-1))
    stacks = {name: jnp.concatenate(parts) for name, parts in kernels.items()}
    return stacks | ({"rest": jnp.concatenate(rest)} if rest else {})


def unstacked(stacks: Stacks, like: Any) -> Any:
    """The inverse of `stacked`: parameters in the shapes of `like`."""
    taken = defaultdict(int)

    def take(path: tuple, leaf: Any) -> Any:
        name = _shape_name(leaf) if _is_matrix(path) else "rest"
        name = name if name in stacks else "rest"
        count = math.prod(leaf.shape) // math.prod(stacks[name].shape[1:])
        first, taken[name] = taken[name], taken[name] + count
        return stacks[name][first : first + count].reshape(leaf.shape)

    return jax.tree.map_with_path(take, like)


def _is_matrix(path: tuple) -> bool:
    return bool(path) and getattr(path[-1], "key", None) in MATRICES


def _shape_name(kernel: Any) -> str:
    return "x".join(map(str, kernel.shape[-2:]))
