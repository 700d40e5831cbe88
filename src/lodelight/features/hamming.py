"""Hamming distance of 256-bit descriptors, held as four 64-bit words."""

from typing import Any

from numba import types
from numba.extending import intrinsic

from lodelight.compiled import kernel
from lodelight.types import Words


def _count_bits(typing_context: Any, word: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), codegen


# One machine instruction; numba has no call for it.
popcount: Any = intrinsic(_count_bits)


@kernel
def hamming(a: Words, b: Words) -> int:
    """Number of differing bits of two descriptors (4,) uint64."""
    return int(popcount(a[0] ^ b[0]) + popcount(a[1] ^ b[1]) + popcount(a[2] ^ b[2]) + popcount(a[3] ^ b[3]))
