"""What the window still knows of what has left it: a quadratic about where it was linearized, chi-square

    d^T H d + 2 g^T d,     d = x [-] lin, the unknowns in the chart of their states

Source: science note C6; Sibley, Matthies, Sukhatme, "Sliding window filter", 2010; Huang, Mourikis, Roumeliotis,
"Observability-based rules", 2010 (first-estimate Jacobians). Derivation: docs/derivations-inertial.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from lodelight.types import Array, Bools

# ("pose", frame) 6: theta, p; ("rest", frame) 9: v, bg, ba; ("mount", camera) 6; ("offset", 0) 1; ("tag", number) 6
Key: TypeAlias = tuple[str, int]
DIM = {"pose": 6, "rest": 9, "mount": 6, "offset": 1, "tag": 6}
# Directions of the scaled system that are this much weaker than its strongest say nothing: rounding of double numbers
WEAKEST = 1e-13
# What is left of the gauge when it is released: m, rad
LOOSE_M, LOOSE_RAD = 30.0, 2.0


def schur(H: Array, g: Array, gone: Bools) -> tuple[Array, Array]:
    """(H, g) of the other unknowns after those in the mask `gone` (n,) have been marginalized.

    By the eigenvalues of the part that goes, scaled to a unit diagonal: its units run from 1 to 1e12.
    """
    kept = ~gone
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[gone], 1e-300))
    values, vectors = np.linalg.eigh(H[np.ix_(gone, gone)] * np.outer(scale, scale))
    strong = values > WEAKEST * max(values[-1], 0.0)
    root = (vectors[:, strong] / np.sqrt(values[strong])) * scale[:, None]  # root root^T = pseudo-inverse
    half = H[np.ix_(kept, gone)] @ root
    reduced: Array = H[np.ix_(kept, kept)] - half @ half.T
    gradient: Array = g[kept] - half @ (root.T @ g[gone])
    return 0.5 * (reduced + reduced.T), gradient


@dataclass
class Prior:
    """keys : unknowns in the order of H (q, q) and g (q,)"""

    keys: list[Key] = field(default_factory=list)
    H: Array = field(default_factory=lambda: np.zeros((0, 0)))
    g: Array = field(default_factory=lambda: np.zeros(0))

    def spans(self) -> dict[Key, slice]:
        out, at = {}, 0
        for key in self.keys:
            out[key] = slice(at, at + DIM[key[0]])
            at += DIM[key[0]]
        return out

    def without(self, gone: Sequence[Key]) -> Prior:
        """After these unknowns have been marginalized."""
        leaving = set(gone)
        mask = np.concatenate([np.full(DIM[key[0]], key in leaving) for key in self.keys])
        H, g = schur(self.H, self.g, mask)
        return Prior([key for key in self.keys if key not in leaving], H, g)

    def null_space(self, lin: Mapping[Key, Array]) -> Array:
        """(q, 4) what turning the world about z and moving it along x, y, z does to the unknowns at lin.

        lin : rows (21,) of frames under ("pose", frame), rows (12,) of tags
        """
        N = np.zeros((len(self.g), 4))
        for key, span in self.spans().items():
            if key[0] in ("pose", "tag"):
                x = lin[key]
                N[span.start : span.start + 3, 0] = x[6:9]  # R^T e_z, the last row of R
                N[span.start + 3, 0], N[span.start + 4, 0] = -x[10], x[9]
                N[span.start + 3 : span.stop, 1:] = np.eye(3)
            elif key[0] == "rest":
                x = lin[("pose", key[1])]
                N[span.start, 0], N[span.start + 1, 0] = -x[13], x[12]
        return N

    def turned(self, R_new_old: Array) -> Prior:
        """In a frame whose axes are turned: positions and velocities are errors along the world's axes."""
        B = np.eye(len(self.g))
        for key, span in self.spans().items():
            if key[0] in ("pose", "tag"):
                B[span.start + 3 : span.stop, span.start + 3 : span.stop] = R_new_old
            elif key[0] == "rest":
                B[span.start : span.start + 3, span.start : span.start + 3] = R_new_old
        return Prior(self.keys, B @ self.H @ B.T, B @ self.g)

    def carried(self, R_new_old: Array, lin: Mapping[Key, Array], moved: Array) -> Prior:
        """About unknowns that were turned about z and moved together, to lin; the belief itself stays where it is.

        moved (4,) : yaw and position by which they were, as the columns of the null space have it. What is known of the
        unknowns among each other goes along exactly, which a quadratic about the old place says to first order only.
        """
        turned = self.turned(R_new_old)
        return Prior(self.keys, turned.H, turned.g + turned.H @ (turned.null_space(lin) @ moved))

    def released(self, lin: Mapping[Key, Array], adrift: Array | None = None) -> Prior:
        """Without what it knows of absolute yaw and position: as if the frame it is given in were unknown.

        adrift (4, 4) : covariance of a turn about z and a shift that it may be off by, beyond what it knows; default,
        by anything
        """
        if adrift is None:
            adrift = np.diag(np.square([LOOSE_RAD, LOOSE_M, LOOSE_M, LOOSE_M]))
        N = self.null_space(lin) @ np.linalg.cholesky(adrift)
        HN = self.H @ N
        inside = np.linalg.inv(N.T @ HN + np.eye(4))
        H = self.H - HN @ inside @ HN.T
        return Prior(self.keys, 0.5 * (H + H.T), self.g - HN @ inside @ (N.T @ self.g))
