"""Cholesky of large symmetric systems made of 6x6 blocks, few of which are not zero: one block per pair of poses.

A = U^T U over blocks, in an order of elimination that keeps the factor sparse (minimum degree). A system without zeros
is the same code with nothing to skip. No BLAS: no threads, and the same bytes on every machine.
Source: George and Liu, "Computer Solution of Large Sparse Positive Definite Systems", 1981, chapters 5 and 6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.types import Array, Bools, Ints

DIM = 6  # a constant, so that the loops over a block are unrolled


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """Where the blocks of a system and of its factor are.

    position : (n,) when each node is eliminated; blocks and right-hand sides are addressed by position
    slot : (n, n) int32, index of block (i, j) for positions i <= j, -1 where the factor is zero (4 n^2 bytes)
    start, columns : the positions after i to which i couples, columns[start[i]:start[i + 1]], rising
    n_blocks : blocks of the factor, diagonal ones included
    """

    position: Ints
    slot: Ints
    start: Ints
    columns: Ints
    n_blocks: int

    @staticmethod
    def of(coupled: Bools) -> BlockPlan:
        """From a symmetric (n, n) matrix of which nodes couple; its diagonal is not looked at."""
        position, slot, start, columns = _plan(coupled.copy())
        return BlockPlan(position, slot, start, columns, len(columns) + len(position))

    def factor(self, blocks: Array) -> bool:
        """blocks (n_blocks, 6, 6), of which the diagonal ones by their upper half, become U; False if not definite."""
        return factor(blocks, self.slot, self.start, self.columns)

    def solve(self, blocks: Array, b: Array) -> None:
        """b (n, 6), rows by position, becomes the solution."""
        solve(blocks, self.slot, self.start, self.columns, b)


@kernel
def _plan(coupled: Bools) -> tuple[Ints, Ints, Ints, Ints]:
    """Minimum degree: always eliminate the node with fewest neighbours, which then all become each other's."""
    n = coupled.shape[0]
    for i in range(n):
        coupled[i, i] = False
    degree = np.zeros(n, np.int32)
    for i in range(n):
        for j in range(n):
            degree[i] += coupled[i, j]
    order, position = np.empty(n, np.int32), np.full(n, -1, np.int32)
    neighbours = np.empty(n, np.int32)
    for k in range(n):
        node = -1
        for i in range(n):
            if position[i] < 0 and (node < 0 or degree[i] < degree[node]):
                node = i
        order[k], position[node] = node, k
        m = 0
        for j in range(n):
            if coupled[node, j] and position[j] < 0:
                neighbours[m] = j
                m += 1
        for x in range(m):
            i = neighbours[x]
            degree[i] -= 1
            if m < n - k - 1:  # else all that is left is coupled already
                for y in range(x):
                    j = neighbours[y]
                    if not coupled[i, j]:
                        coupled[i, j] = coupled[j, i] = True
                        degree[i] += 1
                        degree[j] += 1
    slot = np.full((n, n), -1, np.int32)
    start = np.zeros(n + 1, np.int32)
    total = 0
    for k in range(n):
        for j in range(k + 1, n):
            total += coupled[order[k], order[j]]
        start[k + 1] = total
    columns = np.empty(total, np.int32)
    for k in range(n):
        at = start[k]
        slot[k, k] = at + k
        for j in range(k + 1, n):
            if coupled[order[k], order[j]]:
                columns[at] = j
                slot[k, j] = at + k + 1
                at += 1
    return position, slot, start, columns


@kernel
def factor(S: Array, slot: Ints, start: Ints, columns: Ints) -> bool:
    for k in range(len(start) - 1):
        d = slot[k, k]
        for a in range(DIM):
            for r in range(a):
                f = S[d, r, a]
                for b in range(a, DIM):
                    S[d, a, b] -= f * S[d, r, b]
            if not S[d, a, a] > 0.0:
                return False
            inverse = 1.0 / math.sqrt(S[d, a, a])
            for b in range(a, DIM):
                S[d, a, b] *= inverse
        for x in range(start[k], start[k + 1]):
            s = slot[k, columns[x]]
            for a in range(DIM):
                for r in range(a):
                    f = S[d, r, a]
                    for b in range(DIM):
                        S[s, a, b] -= f * S[s, r, b]
                inverse = 1.0 / S[d, a, a]
                for b in range(DIM):
                    S[s, a, b] *= inverse
        for x in range(start[k], start[k + 1]):
            i = columns[x]
            si = slot[k, i]
            for y in range(x, start[k + 1]):
                j = columns[y]
                _subtract_product(S, si, slot[k, j], slot[i, j])
    return True


@kernel
def _subtract_product(S: Array, i: int, j: int, out: int) -> None:
    """S[out] -= S[i]^T S[j]"""
    for a in range(DIM):
        x0 = x1 = x2 = x3 = x4 = x5 = 0.0
        for r in range(DIM):
            f = S[i, r, a]
            x0 += f * S[j, r, 0]
            x1 += f * S[j, r, 1]
            x2 += f * S[j, r, 2]
            x3 += f * S[j, r, 3]
            x4 += f * S[j, r, 4]
            x5 += f * S[j, r, 5]
        S[out, a, 0] -= x0
        S[out, a, 1] -= x1
        S[out, a, 2] -= x2
        S[out, a, 3] -= x3
        S[out, a, 4] -= x4
        S[out, a, 5] -= x5


@kernel
def solve(S: Array, slot: Ints, start: Ints, columns: Ints, b: Array) -> None:
    n = len(start) - 1
    for k in range(n):
        d = slot[k, k]
        for a in range(DIM):
            for r in range(a):
                b[k, a] -= S[d, r, a] * b[k, r]
            b[k, a] /= S[d, a, a]
        for x in range(start[k], start[k + 1]):
            j = columns[x]
            s = slot[k, j]
            for r in range(DIM):
                for a in range(DIM):
                    b[j, a] -= S[s, r, a] * b[k, r]
    for k in range(n - 1, -1, -1):
        d = slot[k, k]
        for x in range(start[k], start[k + 1]):
            j = columns[x]
            s = slot[k, j]
            for a in range(DIM):
                for r in range(DIM):
                    b[k, a] -= S[s, a, r] * b[j, r]
        for a in range(DIM - 1, -1, -1):
            for r in range(a + 1, DIM):
                b[k, a] -= S[d, a, r] * b[k, r]
            b[k, a] /= S[d, a, a]
