"""Lights in bundle adjustment: numeric derivatives, an independent optimizer, and what they tie to the world."""

import numpy as np
from scipy.optimize import least_squares

from estimator_scenes import LENSES, T_BODY_CAM, chart_error, walk
from light_scenes import SPEC, UP
from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.estimation.factors.light import LightViews
from lodelight.estimation.factors.reprojection import reprojection
from lodelight.geometry.se3 import SE3

SIGMA_PX, SIGMA_M = 0.5, 0.005


def lit(rng, poses, count=6, noise=1.0):
    """Lights over a path of bodies, each seen by all, some moments after the keyframe; and where they really hang."""
    ceiling = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(3.0, 4.0, count)])
    ceiling = ceiling + np.mean([T.t for T in poses], axis=0)
    R, p, px, keyframe, light = [], [], [], [], []
    for k, T in enumerate(poses):
        level = SE3(
            T.R.T @ UP, np.array([0.02, 0.01, 0.08])
        )  # the light camera of this body looks up, whatever it does
        for q in range(count):
            moved = SE3.exp(rng.normal(size=6) * 0.02)
            T_keyframe_cam = moved @ level
            X = (T @ T_keyframe_cam).inverse() @ ceiling[q]
            seen, inside = SPEC.camera.project(X[None])
            if inside[0]:
                R.append(T_keyframe_cam.R)
                p.append(T_keyframe_cam.t)
                px.append(seen[0] + noise * SIGMA_PX * rng.normal(size=2))
                keyframe.append(k)
                light.append(q)
    surveyed = ceiling + noise * SIGMA_M * rng.normal(size=ceiling.shape)
    views = LightViews(
        SPEC.camera, surveyed, np.full(count, SIGMA_M), np.array(keyframe), np.array(light), np.array(R), np.array(p),
        np.array(px), np.full(len(px), SIGMA_PX),
    )  # fmt: skip
    return views, ceiling


def light_rows(views, poses, xyz):
    out = []
    for i, (k, q) in enumerate(zip(views.keyframe, views.light, strict=True)):
        T = poses[k] @ SE3(views.R[i], views.p[i])
        px, _ = SPEC.camera.project((T.inverse() @ xyz[q])[None])
        out.append((px[0] - views.px[i]) / views.sigma_px[i])
    return np.concatenate([*out, ((xyz - views.xyz) / views.sigma_m[:, None]).ravel()])


def test_jacobians_match_central_differences():
    rng = np.random.default_rng(0)
    poses = [SE3.exp(rng.normal(size=6) * [0.3, 0.3, 2.0, 1.0, 1.0, 0.2]) for _ in range(4)]
    views, ceiling = lit(rng, poses, noise=0.0)
    for i in range(len(views.px)):
        T, cam, X = poses[views.keyframe[i]], SE3(views.R[i], views.p[i]), ceiling[views.light[i]]

        def r(T, X, cam=cam, i=i):
            E = np.zeros((2, 3))
            return reprojection(
                SPEC.camera.model, SPEC.camera.params, T.R, T.t, cam.R, cam.t, *X, *views.px[i], SIGMA_PX, 0.0, 1.0, E
            )

        rows, at_truth, Ju, Jv, _ = r(T, X)
        assert rows == 2
        assert np.abs(at_truth).max() < 1e-9
        h = 1e-6
        for a in range(6):
            d = np.zeros(6)
            d[a] = h
            numeric = (np.array(r(T.perturbed(d), X)[1]) - r(T.perturbed(-d), X)[1])[:2] / (2 * h)
            sign = 1.0 if a < 3 else -1.0  # dr/dp = -dr/dX
            np.testing.assert_allclose(sign * np.array([Ju[a], Jv[a]]), numeric, rtol=1e-6, atol=1e-4)


def test_adjustment_with_lights_agrees_with_scipy():
    rng = np.random.default_rng(1)
    made = walk(rng, LENSES["radtan"], 4, 25, per_point=4.0)
    many = np.bincount(made.problem.point, minlength=25)[made.problem.point] >= 2
    q = made.problem
    views, _ = lit(rng, [SE3(R, p) for R, p in zip(made.problem.R, made.problem.p, strict=True)], 3)
    columns = ("keyframe", "point", "px", "sigma_px", "inv_depth", "sigma_inv_depth")
    problem = BundleProblem(
        q.camera, q.T_body_cam, q.R, q.p, np.zeros(4, bool), q.xyz, **{c: getattr(q, c)[many] for c in columns},
        lights=views,
    )  # fmt: skip
    ours = bundle_adjust(problem, 50, robust=False)
    start = [SE3(R, p) for R, p in zip(q.R, q.p, strict=True)]

    def residuals(x):
        poses = [T.perturbed(x[6 * k : 6 * k + 6]) for k, T in enumerate(start)]
        xyz = q.xyz + x[24:99].reshape(-1, 3)
        out = [light_rows(views, poses, views.xyz + x[99:].reshape(-1, 3))]
        for k, T in enumerate(poses):
            rows = np.flatnonzero(problem.keyframe == k)
            X = (T @ T_BODY_CAM).inverse() @ xyz[problem.point[rows]]
            out.append(((q.camera.project(X)[0] - problem.px[rows]) / problem.sigma_px[rows, None]).ravel())
            deep = problem.inv_depth[rows] > 0
            out.append(((1 / X[:, 2] - problem.inv_depth[rows]) / problem.sigma_inv_depth[rows])[deep])
        return np.concatenate(out)

    theirs = least_squares(residuals, np.zeros(99 + 3 * len(views.xyz)), x_scale="jac", xtol=1e-12, ftol=1e-12)
    assert abs(ours.cost[-1] - 2 * theirs.cost) < 1e-4 * ours.cost[-1]
    for k, T in enumerate(start):
        expected = T.perturbed(theirs.x[6 * k : 6 * k + 6])
        assert np.linalg.norm(ours.p[k] - expected.t) < 1e-4
    assert len(ours.light_chi2) == len(views.px)


def test_lights_alone_hold_a_map_that_nothing_is_fixed_in():
    """All poses start 2 cm and 0.6 deg off together; the lights bring them to where they are."""
    rng = np.random.default_rng(2)
    made = walk(rng, LENSES["radtan"], 6, 80, depth=1.0)
    views, _ = lit(rng, made.truth)
    off = SE3.exp(np.array([0.003, -0.002, 0.01, 0.02, -0.01, 0.015]))
    wrong = [off @ T for T in made.truth]
    problem = BundleProblem(
        made.problem.camera, made.problem.T_body_cam, np.array([T.R for T in wrong]), np.array([T.t for T in wrong]),
        np.zeros(6, bool), off @ made.xyz, made.problem.keyframe, made.problem.point, made.problem.px,
        made.problem.sigma_px, made.problem.inv_depth, made.problem.sigma_inv_depth, lights=views,
    )  # fmt: skip
    found = bundle_adjust(problem, 30, robust=False, covariance_of=[0, 3, 5])
    for k, covariance in zip([0, 3, 5], found.covariance, strict=True):
        e = chart_error(SE3(found.R[k], found.p[k]), made.truth[k])
        assert e @ np.linalg.solve(covariance, e) < 22.5  # 99.9 % of six degrees of freedom
        assert np.sqrt(np.diag(covariance)[3:]).max() < 0.03  # six lights in a bundle, surveyed to 5 mm, 3 to 4 m away
