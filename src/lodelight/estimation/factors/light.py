"""A coded light seen by the light camera: reprojection of a point that is known beforehand.

    X_cam = R_body_cam^T (R^T (P - p) - p_body_cam),   r = (pi(X_cam) - u) / sigma_px,   r_survey = (P - P_0) / sigma_m

It is the reprojection factor without a depth, of a camera of its own for every sighting: T_body_cam holds how the
light camera sits on the body and how the body moved between its keyframe and the time at which the light's row was
exposed, T_keyframe_cam = T_keyframe_body(t) T_body_lightcam. The light's place P is a point of the adjustment, held to
its survey.
Derivation: docs/derivations-reprojection.md, docs/lights.md. Source: science note D.
"""

from __future__ import annotations

from dataclasses import dataclass

from lodelight.geometry.cameras import Camera
from lodelight.types import AnyArray


@dataclass(frozen=True, eq=False)
class LightViews:
    """L sightings of Q surveyed lights, beside the observations of a bundle problem.

    xyz (Q, 3) m, world, as surveyed; sigma_m (Q,)
    keyframe (L,) : row of the pose in the problem; light (L,) : row of the light
    R (L, 3, 3), p (L, 3) m : T_keyframe_cam; px (L, 2) : where the light's centre is seen; sigma_px (L,)
    """

    camera: Camera
    xyz: AnyArray
    sigma_m: AnyArray
    keyframe: AnyArray
    light: AnyArray
    R: AnyArray
    p: AnyArray
    px: AnyArray
    sigma_px: AnyArray
