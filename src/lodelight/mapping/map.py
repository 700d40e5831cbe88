"""The map: keyframes, their features, and points, as growing arrays with stable ids.

An observation is a feature row that names a point (`features.point`); the features of one point form a linked list
(`points.head`, `features.next`). Both ways are plain arrays, so covisibility is counted when it is asked for and
nothing has to be kept in step. Rows are never moved: a culled keyframe or point is only marked dead.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.mapping import kernels
from lodelight.mapping.anchoring import Anchoring
from lodelight.mapping.table import Table
from lodelight.rig import Rig
from lodelight.types import AnyArray, Array, Ints


class Map:
    """Everything a system knows of a building.

    keyframes : t_ns, R (3, 3) and p (3,) m of T_world_body (of T_parent_body once it is culled), weight,
                noise (sigma of its corners over a sharp frame's), covariance (6, 6) of the pose against the
                root's, chart of SE3.perturbed, parent (spanning tree, -1 = root), first_feature, n_features, alive
    features  : keyframe, px (2,), octave, angle, desc (4,), inv_depth, sigma_inv_depth, point (-1 = none),
                next (the next feature of the same point, -1 = last)
    points    : xyz (3,) m world, desc (4,), normal (3,) mean viewing direction, d_min, d_max m (where its scale can
                be matched), head (first feature), n_obs, n_visible, n_found, first_keyframe, replaced_by, alive
    loops     : a, b (keyframes), R (3, 3), p (3,) of the measured T_a_b
    tags      : name ("family id", UTF-8), size_m, R (3, 3), p (3,) of T_world_tag, covariance (6, 6), surveyed (R and
                p are a survey's and are not adjusted), placed (R and p are known)
    tag_views : keyframe, tag, R (3, 3), p (3,) of T_keyframe_body of the image, own (it is the keyframe's own image),
                t_ns, px (4, 2), sigma_px (4,) of the corners, usable (no gate was against it)
    anchoring : what ties keyframes to the world; not saved
    lock      : held by whoever changes or reads several columns, for mapping on its own thread
    """

    def __init__(self, rig: Rig) -> None:
        f32, f64, i32, i64, u64 = np.float32, np.float64, np.int32, np.int64, np.uint64
        self.rig = rig
        self.anchoring = Anchoring()
        self.lock = threading.RLock()
        self.keyframes = Table(
            t_ns=(i64, ()), R=(f64, (3, 3)), p=(f64, (3,)), weight=(f64, ()), noise=(f64, ()),
            covariance=(f64, (6, 6)), parent=(i32, ()), first_feature=(i32, ()), n_features=(i32, ()),
            alive=(np.bool_, ()),
        )  # fmt: skip
        self.features = Table(
            keyframe=(i32, ()), px=(f32, (2,)), octave=(i32, ()), angle=(f32, ()), desc=(u64, (4,)),
            inv_depth=(f32, ()), sigma_inv_depth=(f32, ()), point=(i32, ()), next=(i32, ()),
        )  # fmt: skip
        self.points = Table(
            xyz=(f64, (3,)), desc=(u64, (4,)), normal=(f64, (3,)), d_min=(f64, ()), d_max=(f64, ()),
            head=(i32, ()), n_obs=(i32, ()), n_visible=(i32, ()), n_found=(i32, ()),
            first_keyframe=(i32, ()), replaced_by=(i32, ()), alive=(np.bool_, ()),
        )  # fmt: skip
        self.loops = Table(a=(i32, ()), b=(i32, ()), R=(f64, (3, 3)), p=(f64, (3,)))
        self.tags = Table(
            name=("S80", ()), size_m=(f64, ()), R=(f64, (3, 3)), p=(f64, (3,)), covariance=(f64, (6, 6)),
            surveyed=(np.bool_, ()), placed=(np.bool_, ()),
        )  # fmt: skip
        self.tag_views = Table(
            keyframe=(i32, ()), tag=(i32, ()), R=(f64, (3, 3)), p=(f64, (3,)), own=(np.bool_, ()), t_ns=(i64, ()),
            px=(f64, (4, 2)), sigma_px=(f64, (4,)), usable=(np.bool_, ()),
        )  # fmt: skip

    def save(self, path: str | Path) -> None:
        """Write the map file; see `lodelight.mapping.store.save_map`."""
        from lodelight.mapping.store import save_map

        save_map(self, path)

    # -- what is there ------------------------------------------------------------------------------------------

    @property
    def tables(self) -> dict[str, Table]:
        """All tables by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Table)}

    @property
    def alive_keyframes(self) -> Ints:
        return np.flatnonzero(self.keyframes.alive).astype(np.int32)

    @property
    def alive_points(self) -> Ints:
        return np.flatnonzero(self.points.alive).astype(np.int32)

    def pose(self, keyframe: int) -> SE3:
        """T_world_body of a keyframe; a culled one moves with its parent."""
        stored = SE3(self.keyframes.R[keyframe].copy(), self.keyframes.p[keyframe].copy())
        if self.keyframes.alive[keyframe] or self.keyframes.parent[keyframe] < 0:
            return stored
        return self.pose(int(self.keyframes.parent[keyframe])) @ stored

    def set_pose(self, keyframe: int, T_world_body: SE3) -> None:
        self.keyframes.R[keyframe] = T_world_body.R
        self.keyframes.p[keyframe] = T_world_body.t

    def move(self, T_new_old: SE3) -> None:
        """Lay the whole map down elsewhere."""
        k, p = self.keyframes, self.points
        absolute = np.flatnonzero(k.alive | (k.parent < 0))  # culled ones are stored relative to their parents
        k.R[absolute] = T_new_old.R @ k.R[absolute]
        k.p[absolute] = T_new_old @ k.p[absolute]
        turn = np.eye(6)
        turn[3:, 3:] = T_new_old.R
        k.covariance[:] = turn @ k.covariance @ turn.T
        p.xyz[:] = T_new_old @ p.xyz
        p.normal[:] = p.normal @ T_new_old.R.T
        t = self.tags
        t.R[:], t.p[:] = T_new_old.R @ t.R, T_new_old @ t.p
        t.covariance[:] = turn @ t.covariance @ turn.T

    def feature_range(self, keyframe: int) -> slice:
        """The feature rows of a keyframe."""
        start = int(self.keyframes.first_feature[keyframe])
        return slice(start, start + int(self.keyframes.n_features[keyframe]))

    def features_of(self, keyframe: int) -> Features:
        """The features of a keyframe as the front end gave them."""
        rows, f = self.feature_range(keyframe), self.features
        ray, _ = self.rig.cameras[0].camera.unproject(f.px[rows])
        return Features(
            f.px[rows], f.octave[rows], f.angle[rows], f.desc[rows], ray, f.inv_depth[rows], f.sigma_inv_depth[rows]
        )

    def points_of(self, keyframe: int) -> Ints:
        """Point of every feature of a keyframe, -1 where there is none; a live view."""
        return self.features.point[self.feature_range(keyframe)]

    def observations(self, point: int) -> list[int]:
        """Feature rows that see a point."""
        rows, row = [], int(self.points.head[point])
        while row >= 0:
            rows.append(row)
            row = int(self.features.next[row])
        return rows

    def covisible(self, keyframe: int, min_shared: int = 1) -> tuple[Ints, Ints]:
        """Keyframes that share at least `min_shared` points with this one, most first, and how many they share."""
        counts = self.shared_counts(self.points_of(keyframe))
        counts[keyframe] = 0
        return _descending(counts, min_shared)

    def shared_counts(self, points: Ints) -> Ints:
        """(n_keyframes,) how many of the given points (-1 = skip) each keyframe sees."""
        return kernels.count_shared(
            points, self.points.head, self.features.next, self.features.keyframe, len(self.keyframes)
        )

    def surviving(self, points: Ints) -> Ints:
        """Point ids with fused ones followed to what replaced them, and dead ones set to -1."""
        return kernels.follow_replaced(points, self.points.replaced_by, self.points.alive)

    # -- how it grows -------------------------------------------------------------------------------------------

    def add_keyframe(
        self, t_ns: int, T_world_body: SE3, seen: Features, weight: float = 1.0, parent: int = -1, noise: float = 1.0
    ) -> int:
        """Append a keyframe with its features, none of them linked to a point yet; returns its id."""
        n, k = len(seen), len(self.keyframes)
        first = self.features.append(
            n, keyframe=k, px=seen.px, octave=seen.octave, angle=seen.angle, desc=seen.desc, inv_depth=seen.inv_depth,
            sigma_inv_depth=seen.sigma_inv_depth, point=-1, next=-1,
        )  # fmt: skip
        return self.keyframes.append(
            1, t_ns=t_ns, R=T_world_body.R, p=T_world_body.t, weight=weight, noise=noise, parent=parent,
            first_feature=first, n_features=n, alive=True,
        )  # fmt: skip

    def add_points(self, xyz: Array, first_feature: Ints, keyframe: int) -> Ints:
        """Append points (N, 3) m, each seen by one feature row so far; returns their ids."""
        n = len(xyz)
        start = self.points.append(
            n, xyz=xyz, desc=self.features.desc[first_feature], head=-1, n_visible=1, n_found=1,
            first_keyframe=keyframe, replaced_by=-1, alive=True,
        )  # fmt: skip
        ids = np.arange(start, start + n, dtype=np.int32)
        self.link(first_feature, ids)
        return ids

    def link(self, features: AnyArray, points: AnyArray) -> None:
        """Feature rows see points. A feature that saw another one is unlinked from it first."""
        f, p = self.features, self.points
        kernels.link(
            np.asarray(features, np.int32), np.asarray(points, np.int32), f.point, f.next, p.head, p.n_obs, p.alive
        )

    def unlink(self, features: Iterable[int] | AnyArray) -> None:
        """Feature rows see nothing any more; a point left without observation dies."""
        f, p = self.features, self.points
        kernels.unlink(np.asarray(features, np.int32), f.point, f.next, p.head, p.n_obs, p.alive)

    def remove_points(self, points: Iterable[int] | AnyArray) -> None:
        for point in points:
            self.unlink(self.observations(int(point)))
            self.points.alive[point] = False

    def remove_keyframe(self, keyframe: int) -> None:
        """Forget a keyframe: its observations go, its children in the spanning tree pass to its parent.

        Culled children too, so that none hangs on a chain of culled ones, which would grow with the run.
        """
        rows = np.arange(self.feature_range(keyframe).start, self.feature_range(keyframe).stop, dtype=np.int32)
        self.unlink(rows)
        kf, parent = self.keyframes, int(self.keyframes.parent[keyframe])
        children = kf.parent == keyframe
        if parent >= 0:
            T_parent_keyframe = self.pose(parent).inverse() @ self.pose(keyframe)
            for child in np.flatnonzero(children & ~kf.alive).tolist():
                self.set_pose(child, T_parent_keyframe @ SE3(kf.R[child].copy(), kf.p[child].copy()))
                kf.parent[child] = parent
            self.set_pose(keyframe, T_parent_keyframe)
        kf.parent[children & kf.alive] = parent
        kf.alive[keyframe] = False

    def fuse_points(self, old: int, new: int) -> None:
        """`new` takes over the observations of `old`, save in keyframes where it is seen already."""
        f, p = self.features, self.points
        kernels.fuse(
            old, new, f.point, f.next, f.keyframe, p.head, p.n_obs, p.n_visible, p.n_found, p.replaced_by, p.alive
        )

    def join(self, features: AnyArray, points: AnyArray) -> None:
        """Feature rows see points; where one saw another point, the two become one."""
        f, p = self.features, self.points
        kernels.join(
            np.asarray(features, np.int32), np.asarray(points, np.int32), f.point, f.next, f.keyframe,
            p.head, p.n_obs, p.n_visible, p.n_found, p.replaced_by, p.alive,
        )  # fmt: skip

    def refresh_points(self, points: AnyArray, scale_factor: float, n_levels: int) -> None:
        """Recompute descriptor (the medoid of its observations), normal and scale range of points."""
        f, p, k = self.features, self.points, self.keyframes
        T_body_cam = self.rig.cameras[0].T_body_cam
        centres = k.p + np.einsum("nij,j->ni", k.R, T_body_cam.t)
        kernels.refresh_points(
            np.asarray(points, np.int32), centres, f.keyframe, f.next, f.octave, f.desc,
            p.head, p.xyz, p.desc, p.normal, p.d_min, p.d_max, scale_factor, n_levels,
        )  # fmt: skip


def _descending(counts: Ints, at_least: int) -> tuple[Ints, Ints]:
    """Indices with count >= at_least, by falling count, ties by rising index."""
    index = np.flatnonzero(counts >= max(at_least, 1)).astype(np.int32)
    index = index[np.argsort(-counts[index], kind="stable")]
    return index, counts[index]
