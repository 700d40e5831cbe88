"""Circles seen in perspective: the centre of their image, and the two poses an image of one may have.

Coordinates in the image plane are normalized, (x / z, y / z). Source: science note A5; Chen et al. 2004 for the pose.
"""

from __future__ import annotations

import numpy as np

from lodelight.errors import SourceError
from lodelight.types import Array


def image_of_disc(centre: Array, normal: Array, radius_m: float | Array) -> Array:
    """(..., 3, 3) symmetric, the dual conic that a disc's rim is seen as; centre, unit normal (..., 3) in the camera.

    With axes a, b across the normal and H = [r a, r b, c] it is H diag(1, 1, -1) H^T = r^2 (I - n n^T) - c c^T.
    """
    r2 = np.asarray(radius_m)[..., None, None] ** 2
    dual: Array = (
        r2 * (np.eye(3) - normal[..., :, None] * normal[..., None, :]) - centre[..., :, None] * centre[..., None, :]
    )
    return dual


def conic_centre(dual: Array) -> Array:
    """(..., 2), normalized, of ellipses given by their dual conics: not where a disc's centre is seen, but near it."""
    centre: Array = dual[..., :2, 2] / dual[..., 2, 2, None]
    return centre


def disc_poses(conic: Array, radius_m: float) -> list[tuple[Array, Array]]:
    """Centre (m) and unit normal, towards the camera, of a disc with that image: two, equal if seen squarely.

    conic : (3, 3) symmetric with (x, y, 1) Q (x, y, 1)^T = 0 on the rim, normalized coordinates
    Raises SourceError where the conic is no ellipse.
    """
    values, V = np.linalg.eigh(conic if np.linalg.det(conic) < 0 else -conic)
    order = np.argsort(-values)  # two positive, largest first, then the negative one
    (l1, l2, l3), V = values[order], V[:, order]
    if not l1 >= l2 > 0.0 > l3:
        raise SourceError("the outline is no ellipse; a light's image is one")
    g, h = np.sqrt((l2 - l3) / (l1 - l3)), np.sqrt(max(l1 - l2, 0.0) / (l1 - l3))
    z0 = l2 * radius_m / np.sqrt(-l1 * l3)
    found: list[tuple[Array, Array]] = []
    for s1 in (1.0, -1.0):
        for s2 in (1.0, -1.0):
            centre = z0 * V @ np.array([s2 * l3 / l2 * h, 0.0, -s1 * l1 / l2 * g])
            normal = V @ np.array([s2 * h, 0.0, -s1 * g])
            for sign in (1.0, -1.0):
                c = sign * centre
                if c[2] > 0.0 and normal @ c < 0.0:
                    found.append((c, normal))
    return found


def ellipse_conic(centre: Array, cov: Array) -> Array:
    """Q of the ellipse (x - c)^T cov^-1 (x - c) = 1."""
    A = np.linalg.inv(cov)
    Q = np.empty((3, 3))
    Q[:2, :2] = A
    Q[:2, 2] = Q[2, :2] = -A @ centre
    Q[2, 2] = centre @ A @ centre - 1.0
    return Q
