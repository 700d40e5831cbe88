"""What bundle adjustment is asked and what it answers, and its observations as one list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.estimation.factors.light import LightViews
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.types import AnyArray, Array, Bools, Ints


@dataclass(frozen=True, eq=False)
class BundleProblem:
    """K poses, M points, N observations of one camera, and perhaps of lights by another; nothing here is written to.

    R (K, 3, 3), p (K, 3) m : T_world_body; fixed (K,) : poses that are not moved
    xyz (M, 3) m, world; fixed_points (M,) : points that are not moved (surveyed corners); default none
    keyframe, point (N,) : who sees what; px (N, 2), sigma_px (N,) raw pixels
    inv_depth, sigma_inv_depth (N,) 1/m along the camera's z, inv_depth 0 = not measured
    weight (N,) : scales what an observation says, not its test as an outlier; default 1

    Without a fixed pose or a prior the result floats: damping holds it near its start.
    """

    camera: Camera
    T_body_cam: SE3
    R: AnyArray
    p: AnyArray
    fixed: AnyArray
    xyz: AnyArray
    keyframe: AnyArray
    point: AnyArray
    px: AnyArray
    sigma_px: AnyArray
    inv_depth: AnyArray
    sigma_inv_depth: AnyArray
    weight: AnyArray | None = None
    fixed_points: AnyArray | None = None
    priors: Sequence[PosePrior] = ()
    lights: LightViews | None = None


@dataclass(frozen=True, eq=False)
class BundleResult:
    """R, p, xyz : as in the problem, adjusted
    inliers, chi2 : (N,) in the problem's order, at the result; chi2 is unweighted, inf where not seen
    light_chi2 : (L,) of the lights' sightings, likewise
    cost : after each iteration, the start first; it may rise where the kernel is taken off or outliers leave
    covariance : (len(covariance_of), 6, 6), chart of SE3.perturbed; zero for a fixed pose
    """

    R: Array
    p: Array
    xyz: Array
    inliers: Bools
    chi2: Array
    cost: list[float]
    covariance: Array
    light_chi2: Array


@dataclass(frozen=True, eq=False)
class Observations:
    """What the camera and the light camera see, one after the other; the lights come after the points.

    lenses : models (C,), params (C, 12), R (C, 3, 3), p (C, 3) of T_body_cam: camera 0, then one for each sighting
    """

    lenses: tuple[Ints, Array, Array, Array]
    lens: Ints
    xyz: Array
    fixed_points: Bools
    keyframe: AnyArray
    point: AnyArray
    px: AnyArray
    sigma_px: AnyArray
    inv_depth: AnyArray
    sigma_inv_depth: AnyArray
    weight: AnyArray


def observations_of(q: BundleProblem) -> Observations:
    n, m = len(q.keyframe), len(q.xyz)
    weight = np.ones(n) if q.weight is None else q.weight
    held = np.zeros(m, bool) if q.fixed_points is None else q.fixed_points
    models, params = np.array([q.camera.model], np.int32), as_f64(q.camera.params)[None]
    R, p, lens = as_f64(q.T_body_cam.R)[None], as_f64(q.T_body_cam.t)[None], np.zeros(n, np.int32)
    if q.lights is None:
        return Observations(
            (models, params, R, p), lens, as_f64(q.xyz), np.ascontiguousarray(held, bool), q.keyframe, q.point,
            q.px, q.sigma_px, q.inv_depth, q.sigma_inv_depth, weight,
        )  # fmt: skip
    s = q.lights
    many, zero = len(s.keyframe), np.zeros(len(s.keyframe))
    lenses = (
        np.concatenate([models, np.full(many, s.camera.model, np.int32)]),
        np.concatenate([params, np.repeat(as_f64(s.camera.params)[None], many, axis=0)]),
        np.concatenate([R, as_f64(s.R)]), np.concatenate([p, as_f64(s.p)]),
    )  # fmt: skip
    join = np.concatenate
    return Observations(
        lenses, join([lens, 1 + np.arange(many, dtype=np.int32)]), join([as_f64(q.xyz), as_f64(s.xyz)]),
        join([np.asarray(held, bool), np.zeros(len(s.xyz), bool)]), join([q.keyframe, s.keyframe]),
        join([q.point, m + np.asarray(s.light)]), join([q.px, s.px]), join([q.sigma_px, s.sigma_px]),
        join([q.inv_depth, zero]), join([q.sigma_inv_depth, zero + 1.0]), join([weight, zero + 1.0]),
    )  # fmt: skip


def as_f64(a: AnyArray) -> Array:
    return np.ascontiguousarray(a, dtype=np.float64)
