"""Hamming distance of 256-bit descriptors, held as four 64-bit words."""

from typing import Any

from numba import types
from numba.extending import intrinsic

from lodelight.compiled import kernel
from lodelight.types import Words


@intrinsic  # type: ignore[untyped-decorator]
def _popcount(typing_context: Any, word: Any) -> Any:
    """Number of set bits: one machine instruction (numba has no call for it)."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


@kernel
def hamming(a: Words, b: Words) -> int:
    """Number of differing bits of two descriptors (4,) uint64."""
    return int(_popcount(a[0] ^ b[0]) + _popcount(a[1] ^ b[1]) + _popcount(a[2] ^ b[2]) + _popcount(a[3] ^ b[3]))
