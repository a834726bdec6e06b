"""Arrays and a text in one safetensors file, with a digest of both: what was damaged is never loaded."""

import hashlib
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from flx.files import write_atomically

Tensors = dict[str, np.ndarray]


def save_tensors(
    path: Path, tensors: Tensors, key: str, text: str, card: dict[str, str] | None = None
) -> None:
    """Write the file whole or not at all; the text is stored under `key`, beside the entries of the card."""
    # One entry: several are written in any order, and the same content as other bytes.
    write_atomically(path, save(tensors, {key: f"{content_digest(tensors, text)} {text}", **(card or {})}))


def load_tensors(path: Path, key: str) -> tuple[str, Tensors]:
    """The text under `key`, and the arrays. Nothing in the file is executed.

    Raises ValueError, with a reason in one line, where the file is missing or damaged or has no such text.
    """
    if path.exists() and not path.is_file():  # of a pipe, the reader would wait for ever
        raise ValueError("it is not a file")
    try:
        with safe_open(path, "numpy") as file:
            entry = (file.metadata() or {})[key]
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(one_line(error)) from None
    if entry.startswith("{"):  # weights of earlier versions have no digest
        return entry, tensors
    digest, _, text = entry.partition(" ")
    if digest != content_digest(tensors, text):
        raise ValueError("its content is not what was written")
    for name, tensor in tensors.items():
        if tensor.dtype.kind in "fc" and not np.isfinite(tensor).all():
            raise ValueError(f"{name} is not finite")
    return text, tensors


def content_digest(tensors: Tensors, text: str) -> str:
    """SHA-256 of the whole content."""
    digest = hashlib.sha256(text.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tensor.shape}".encode())
        digest.update(np.ascontiguousarray(tensor).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def one_line(error: Exception) -> str:
    """The reason in the first line of an error, for a message."""
    return str(error).splitlines()[0] if str(error) else type(error).__name__
