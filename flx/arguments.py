"""What callers give to a public function, checked at the door: one line with its name, value and remedy."""

import math
import operator
import os
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any


def check_kind(name: str, value: object, kind: type, remedy: str) -> None:
    """Raises ValueError where an argument is not of its kind; `remedy` says where one comes from."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {briefly(value)}; give {remedy}")


def whole(name: str, value: object, least: int = 0) -> int:
    """The argument as an int. Raises ValueError where it is not a whole number, or less than `least`."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise ValueError(f"{name} is {briefly(value)}; give a whole number of at least {least}")
    if number < least:
        raise ValueError(f"{name} is {number}; give at least {least}")
    return number


def counted(value: float | int) -> str:
    """A count in digits; one of more than nine digits as a power of ten."""
    return f"{value:,.0f}" if value < 1e9 else f"{value:.0e}"


def number(name: str, value: object, least: float | int = -math.inf) -> float:
    """The argument as a float. Raises ValueError where it is not a finite number, or less than `least`."""
    wanted = "a number" if least == -math.inf else f"a number of at least {least:g}"
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} is {briefly(value)}; give {wanted}")
    if value < least:
        raise ValueError(f"{name} is {value}; give at least {least:g}")
    return float(value)


def check_word(name: str, value: object, words: Sequence[str]) -> None:
    """Raises ValueError where an argument is not one of the words that it may be."""
    if not isinstance(value, str) or value not in words:
        raise ValueError(f"{name} is {briefly(value)}; choose one of {', '.join(words)}")


def path_of(name: str, value: Any, remedy: str) -> Path:
    """The argument as a path. Raises ValueError where it is none, or empty."""
    if not isinstance(value, str | os.PathLike) or not str(value):
        raise ValueError(f"{name} is {briefly(value)}; give {remedy}")
    return Path(value)


def briefly(value: object) -> str:
    """A value in a message: itself where it is short, else its kind."""
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value) if len(repr(value)) <= 80 else f"{repr(value)[:77]}…"
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'AEIOUaeiou' else 'a'} {kind}"
