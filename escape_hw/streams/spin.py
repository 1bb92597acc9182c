"""Watching a word of shared memory without sleeping and without the interpreter lock."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

#: Looks between two of which the caller may see to the time: about ten microseconds.
LOOKS = 8000


@intrinsic
def _load(typing_context: Any, address: Any) -> Any:
    """The word of 64 bits at an address, as it is now: a compiler would look once and believe it for ever."""

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        pointer = builder.inttoptr(arguments[0], word.as_pointer())
        return builder.load_atomic(pointer, "acquire", 8)

    return types.uint64(types.uint64), code


@njit("b1(u8, u8, u8)", nogil=True)
def changes(address, value, looks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whether the word at an address differs from a value, looking so many times at most."""
    for _ in range(looks):
        if _load(address) != value:  # type: ignore[call-arg]
            return np.bool_(True)
    return np.bool_(False)
