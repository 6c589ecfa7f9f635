"""JSON bodies, read without guessing: documents and nested lists of numbers."""

from __future__ import annotations

import itertools
import json
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from worker.fields import MalformedBody, SpecError

#: Most axes of an array written as JSON.
MAX_NDIM: Final = 3

Dtype = Literal["int64", "float64"]


def decoded(body: bytes | str) -> object:
    """Value of a JSON body.

    Raises
    ------
    MalformedBody
        If it is none, or holds NaN, a repeated key, a lone surrogate or absurd nesting.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        fields = dict(pairs)
        if len(fields) < len(pairs):
            raise MalformedBody(("", "A key stands twice in one object"))
        return fields

    def refused(_: str) -> float:
        raise MalformedBody(("", "NaN and Infinity are no JSON"))

    try:
        text = body if isinstance(body, str) else body.decode()
        value: object = json.loads(text, object_pairs_hook=unique, parse_constant=refused)
        if "\\u" in text:
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeError:
        raise MalformedBody(("", "The body is no UTF-8 text, or holds a lone surrogate")) from None
    except RecursionError:
        raise MalformedBody(("", "The body is nested too deeply")) from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise MalformedBody(("", f"The body is no JSON: {error.msg} at {place}")) from None
    except ValueError:  # an integer of more digits than Python reads
        raise MalformedBody(("", "The body holds a number that is too long")) from None
    return value


def parse_array(body: bytes | str) -> npt.NDArray[Any]:
    """Read an array from nested JSON lists: int64 if every number is an integer, else float64.

    Raises
    ------
    MalformedBody
        If the body is no JSON.
    SpecError
        If it is no full, finite array of one to `MAX_NDIM` axes.
    """
    value = decoded(body)
    ndim, first = 0, value
    while isinstance(first, list) and first and ndim <= MAX_NDIM:
        ndim, first = ndim + 1, first[0]
    if not 1 <= ndim <= MAX_NDIM:
        raise SpecError(
            ("", f"Input should be a list of numbers, nested at most {MAX_NDIM} deep and not empty")
        )
    return array_from_lists(value, None, ndim, "")


def array_from_lists(value: object, dtype: Dtype | None, ndim: int, pointer: str) -> npt.NDArray[Any]:
    """Array of lists nested `ndim` deep, without a Python step per number unless one is wrong.

    Parameters
    ----------
    value : object
        What JSON held.
    dtype : {"int64", "float64"} or None
        None: int64 if every number is an integer, else float64.
    ndim : int
        Axes that the array must have.
    pointer : str
        Where the list stands in its body.

    Raises
    ------
    SpecError
        Naming the first place that is no such number or list.
    """
    level: list[Any] = [value]
    shape: list[int] = []
    for _ in range(ndim):
        lengths = {len(item) if isinstance(item, list) else -1 for item in level}
        if lengths == {0} or len(lengths) > 1 or -1 in lengths:
            wanted = len(level[0]) if isinstance(level[0], list) else 0
            bad = next(
                (k for k, item in enumerate(level) if not isinstance(item, list) or len(item) != wanted), 0
            )
            raise SpecError(
                (pointer + _place(bad, shape), "Input should be a list, not empty and as long as its like")
            )
        shape.append(lengths.pop())
        level = list(itertools.chain.from_iterable(level))
    types = set(map(type, level))
    allowed = {int} if dtype == "int64" else {int, float}
    if not types <= allowed:
        bad = next(k for k, item in enumerate(level) if type(item) not in allowed)
        noun = "integer" if dtype == "int64" else "number"
        raise SpecError((pointer + _place(bad, shape), f"Input should be a valid {noun}"))
    made = dtype or ("int64" if types == {int} else "float64")
    try:
        array: npt.NDArray[Any] = np.array(level, dtype=made)
    except OverflowError:
        bad = next(k for k, number in enumerate(level) if not _fits(number, made))
        raise SpecError((pointer + _place(bad, shape), f"Input should fit {made}")) from None
    if made == "float64" and not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array))[0])
        raise SpecError((pointer + _place(bad, shape), "Input should be a finite number"))
    return array.reshape(shape)


def _fits(number: float, dtype: Dtype) -> bool:
    try:
        np.array(number, dtype=dtype)
    except OverflowError:
        return False
    return True


def _place(flat: int, shape: list[int]) -> str:
    """JSON pointer of a flat index."""
    return "".join(f"/{k}" for k in np.unravel_index(flat, shape)) if shape else ""
