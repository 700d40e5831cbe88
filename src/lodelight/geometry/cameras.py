"""Camera models: pinhole with radial-tangential distortion, equidistant (KB4), double sphere.

Camera frame: x right, y down, z forward. The centre of the top-left pixel is (0, 0).
A model is its number and a parameter row, so that every kernel takes any lens:

    params (12,) = fx fy cx cy  d0 .. d5  limit  0
    RADTAN         d = k1 k2 p1 p2 k3 0      limit: largest (r/z)^2 at which the distortion still grows
    EQUIDISTANT    d = k1 k2 k3 k4 0 0       limit: largest angle from the axis at which it still grows, rad
    DOUBLE_SPHERE  d = xi alpha 0 0 0 0      limit: smallest z / |X| that is still seen

Beyond the limit a lens polynomial folds back into the image; such points are reported as not seen.
Sources: Brown 1966 as in OpenCV; Kannala and Brandt 2006; Usenko, Demmel, Cremers 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.errors import CalibrationError
from lodelight.types import Array, Bools

RADTAN, EQUIDISTANT, DOUBLE_SPHERE = 0, 1, 2
MODELS = {"radtan": RADTAN, "equidistant": EQUIDISTANT, "double_sphere": DOUBLE_SPHERE}
N_DISTORTION = {RADTAN: 5, EQUIDISTANT: 4, DOUBLE_SPHERE: 2}
LIMIT = 10
MIN_DEPTH_M = 0.01


@kernel
def project_point(model: int, p: Array, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Pixel (u, v) of a point in the camera frame, and whether the lens sees it (image bounds not tested)."""
    if model == DOUBLE_SPHERE:
        d1 = math.sqrt(x * x + y * y + z * z)
        if d1 == 0.0 or z < p[LIMIT] * d1:
            return 0.0, 0.0, False
        zs = p[4] * d1 + z
        d2 = math.sqrt(x * x + y * y + zs * zs)
        n = p[5] * d2 + (1.0 - p[5]) * zs
        return p[0] * x / n + p[2], p[1] * y / n + p[3], True
    if model == EQUIDISTANT:
        r = math.hypot(x, y)
        theta = math.atan2(r, z)
        if (r == 0.0 and z <= 0.0) or theta > p[LIMIT]:
            return 0.0, 0.0, False
        t2 = theta * theta
        td = theta * (1.0 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7]))))
        s = td / r if r > 1e-9 else 1.0 / z
        return p[0] * s * x + p[2], p[1] * s * y + p[3], True
    if z < MIN_DEPTH_M:
        return 0.0, 0.0, False
    a, b = x / z, y / z
    r2 = a * a + b * b
    if r2 > p[LIMIT]:
        return 0.0, 0.0, False
    radial = 1.0 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))
    u = a * radial + 2.0 * p[6] * a * b + p[7] * (r2 + 2.0 * a * a)
    v = b * radial + p[6] * (r2 + 2.0 * b * b) + 2.0 * p[7] * a * b
    return p[0] * u + p[2], p[1] * v + p[3], True


@kernel
def project_jacobian(model: int, p: Array, x: float, y: float, z: float, J: Array) -> tuple[float, float, bool]:
    """As `project_point`, filling J (2, 3) = d(u, v) / d(x, y, z); J is zero where the point is not seen."""
    J[:] = 0.0
    if model == DOUBLE_SPHERE:
        d1 = math.sqrt(x * x + y * y + z * z)
        if d1 == 0.0 or z < p[LIMIT] * d1:
            return 0.0, 0.0, False
        xi, alpha = p[4], p[5]
        zs = xi * d1 + z
        d2 = math.sqrt(x * x + y * y + zs * zs)
        n = alpha * d2 + (1.0 - alpha) * zs
        # dn/dX: zs depends on x, y by xi * x / d1, on z by 1 + xi * z / d1
        common = alpha * (1.0 + zs * xi / d1) / d2 + (1.0 - alpha) * xi / d1
        nx, ny = x * common, y * common
        nz = (alpha * zs / d2 + 1.0 - alpha) * (1.0 + xi * z / d1)
        n2 = n * n
        J[0, 0] = p[0] * (1.0 / n - x * nx / n2)
        J[0, 1] = -p[0] * x * ny / n2
        J[0, 2] = -p[0] * x * nz / n2
        J[1, 0] = -p[1] * y * nx / n2
        J[1, 1] = p[1] * (1.0 / n - y * ny / n2)
        J[1, 2] = -p[1] * y * nz / n2
        return p[0] * x / n + p[2], p[1] * y / n + p[3], True
    if model == EQUIDISTANT:
        r = math.hypot(x, y)
        theta = math.atan2(r, z)
        if (r == 0.0 and z <= 0.0) or theta > p[LIMIT]:
            return 0.0, 0.0, False
        if r < 1e-9:
            J[0, 0], J[1, 1] = p[0] / z, p[1] / z
            return p[0] * x / z + p[2], p[1] * y / z + p[3], True
        t2 = theta * theta
        td = theta * (1.0 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7]))))
        dtd = 1.0 + t2 * (3.0 * p[4] + t2 * (5.0 * p[5] + t2 * (7.0 * p[6] + t2 * 9.0 * p[7])))
        r2 = r * r
        R2 = r2 + z * z
        s = td / r
        # d(theta)/d(x, y, z) = (x z / (r R2), y z / (r R2), -r / R2);  ds = (dtd dtheta - s dr) / r
        k = dtd * z / (r2 * R2) - s / r2
        sx, sy, sz = x * k, y * k, -dtd / R2
        J[0, 0] = p[0] * (s + x * sx)
        J[0, 1] = p[0] * x * sy
        J[0, 2] = p[0] * x * sz
        J[1, 0] = p[1] * y * sx
        J[1, 1] = p[1] * (s + y * sy)
        J[1, 2] = p[1] * y * sz
        return p[0] * s * x + p[2], p[1] * s * y + p[3], True
    if z < MIN_DEPTH_M:
        return 0.0, 0.0, False
    a, b = x / z, y / z
    r2 = a * a + b * b
    if r2 > p[LIMIT]:
        return 0.0, 0.0, False
    radial = 1.0 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))
    slope = 2.0 * (p[4] + r2 * (2.0 * p[5] + 3.0 * r2 * p[8]))
    u = a * radial + 2.0 * p[6] * a * b + p[7] * (r2 + 2.0 * a * a)
    v = b * radial + p[6] * (r2 + 2.0 * b * b) + 2.0 * p[7] * a * b
    cross = a * b * slope + 2.0 * (p[6] * a + p[7] * b)
    ua = p[0] * (radial + a * a * slope + 2.0 * p[6] * b + 6.0 * p[7] * a)
    ub = p[0] * cross
    va = p[1] * cross
    vb = p[1] * (radial + b * b * slope + 6.0 * p[6] * b + 2.0 * p[7] * a)
    J[0, 0], J[0, 1] = ua / z, ub / z
    J[1, 0], J[1, 1] = va / z, vb / z
    J[0, 2] = -(ua * a + ub * b) / z
    J[1, 2] = -(va * a + vb * b) / z
    return p[0] * u + p[2], p[1] * v + p[3], True


@kernel
def unproject_point(model: int, p: Array, u: float, v: float) -> tuple[float, float, float, bool]:
    """Unit ray (x, y, z) through a pixel, and whether the lens has one there."""
    a0, b0 = (u - p[2]) / p[0], (v - p[3]) / p[1]
    if model == DOUBLE_SPHERE:
        xi, alpha = p[4], p[5]
        r2 = a0 * a0 + b0 * b0
        root = 1.0 - (2.0 * alpha - 1.0) * r2
        if root < 0.0:
            return 0.0, 0.0, 1.0, False
        mz = (1.0 - alpha * alpha * r2) / (alpha * math.sqrt(root) + 1.0 - alpha)
        under = mz * mz + (1.0 - xi * xi) * r2
        if under < 0.0:
            return 0.0, 0.0, 1.0, False
        k = (mz * xi + math.sqrt(under)) / (mz * mz + r2)
        return k * a0, k * b0, k * mz - xi, True
    if model == EQUIDISTANT:
        td = math.hypot(a0, b0)
        if td < 1e-12:
            return 0.0, 0.0, 1.0, True
        theta = min(td, p[LIMIT])
        for _ in range(20):
            t2 = theta * theta
            f = theta * (1.0 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7])))) - td
            df = 1.0 + t2 * (3.0 * p[4] + t2 * (5.0 * p[5] + t2 * (7.0 * p[6] + t2 * 9.0 * p[7])))
            if df <= 0.0:
                break
            step = f / df
            theta = min(max(theta - step, 0.0), p[LIMIT])
            if abs(step) < 1e-14:
                break
        t2 = theta * theta
        f = theta * (1.0 + t2 * (p[4] + t2 * (p[5] + t2 * (p[6] + t2 * p[7])))) - td
        s = math.sin(theta) / td
        return s * a0, s * b0, math.cos(theta), abs(f) < 1e-9
    a, b = a0, b0
    ok = False
    for _ in range(30):  # Newton on the two-dimensional distortion, from the distorted point
        r2 = a * a + b * b
        radial = 1.0 + r2 * (p[4] + r2 * (p[5] + r2 * p[8]))
        slope = 2.0 * (p[4] + r2 * (2.0 * p[5] + 3.0 * r2 * p[8]))
        fa = a * radial + 2.0 * p[6] * a * b + p[7] * (r2 + 2.0 * a * a) - a0
        fb = b * radial + p[6] * (r2 + 2.0 * b * b) + 2.0 * p[7] * a * b - b0
        if fa * fa + fb * fb < 1e-26:
            ok = r2 <= p[LIMIT]
            break
        cross = a * b * slope + 2.0 * (p[6] * a + p[7] * b)
        j00 = radial + a * a * slope + 2.0 * p[6] * b + 6.0 * p[7] * a
        j11 = radial + b * b * slope + 6.0 * p[6] * b + 2.0 * p[7] * a
        det = j00 * j11 - cross * cross
        if abs(det) < 1e-12:
            break
        da = (j11 * fa - cross * fb) / det
        db = (j00 * fb - cross * fa) / det
        a, b = a - da, b - db
        if da * da + db * db < 1e-28:
            ok = a * a + b * b <= p[LIMIT]
            break
    n = math.sqrt(a * a + b * b + 1.0)
    return a / n, b / n, 1.0 / n, ok


@kernel
def project_points(model: int, p: Array, X: Array) -> tuple[Array, Bools]:
    n = X.shape[0]
    px = np.empty((n, 2))
    seen = np.empty(n, np.bool_)
    for i in range(n):
        px[i, 0], px[i, 1], seen[i] = project_point(model, p, X[i, 0], X[i, 1], X[i, 2])
    return px, seen


@kernel
def unproject_points(model: int, p: Array, px: Array) -> tuple[Array, Bools]:
    n = px.shape[0]
    rays = np.empty((n, 3))
    seen = np.empty(n, np.bool_)
    for i in range(n):
        rays[i, 0], rays[i, 1], rays[i, 2], seen[i] = unproject_point(model, p, px[i, 0], px[i, 1])
    return rays, seen


def _first_turning_point(odd_coefficients: list[float]) -> float:
    """Smallest x > 0 where d/dx of x (1 + c1 x^2 + c2 x^4 + ...) vanishes; inf where it never does."""
    derivative = [1.0, *((2 * i + 3) * c for i, c in enumerate(odd_coefficients))]  # in powers of x^2
    roots = np.roots(derivative[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return math.sqrt(float(real.min())) if len(real) else math.inf


@dataclass(frozen=True, eq=False)
class Camera:
    """A lens and a sensor. `params` is the kernels' row described at the top of this file."""

    model: int
    width: int
    height: int
    params: Array

    @staticmethod
    def create(
        model: str,
        width: int,
        height: int,
        intrinsics: tuple[float, float, float, float],
        distortion: tuple[float, ...] = (),
    ) -> Camera:
        """From fx, fy, cx, cy in px and the model's own coefficients (missing ones are 0).

        Raises CalibrationError on an unknown model, on NaN, and on focal lengths or sizes that are not positive.
        """
        if model not in MODELS:
            raise CalibrationError(f"camera model {model!r} is unknown; choose one of {', '.join(MODELS)}")
        number = MODELS[model]
        if len(distortion) > N_DISTORTION[number]:
            raise CalibrationError(
                f"camera model {model} takes at most {N_DISTORTION[number]} distortion coefficients, "
                f"got {len(distortion)}"
            )
        p = np.zeros(12)
        p[:4] = intrinsics
        p[4 : 4 + len(distortion)] = distortion
        if not np.all(np.isfinite(p)):
            raise CalibrationError(f"intrinsics and distortion must be finite numbers, got {p[:9].tolist()}")
        if p[0] <= 0 or p[1] <= 0:
            raise CalibrationError(f"focal lengths must be positive, got fx={p[0]:g} fy={p[1]:g}")
        if width <= 0 or height <= 0:
            raise CalibrationError(f"image size must be positive, got {width}x{height}")
        if number == RADTAN:
            p[LIMIT] = _first_turning_point([p[4], p[5], p[8]]) ** 2
        elif number == EQUIDISTANT:
            p[LIMIT] = min(_first_turning_point([p[4], p[5], p[6], p[7]]), math.pi)
        else:
            xi, alpha = p[4], p[5]
            if not 0.0 <= alpha <= 1.0:
                raise CalibrationError(f"double sphere alpha must lie in [0, 1], got {alpha:g}")
            w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
            w2 = (w1 + xi) / math.sqrt(2.0 * w1 * xi + xi * xi + 1.0)
            p[LIMIT] = -w2
        return Camera(number, width, height, p)

    @property
    def model_name(self) -> str:
        return next(name for name, number in MODELS.items() if number == self.model)

    @property
    def distortion(self) -> tuple[float, ...]:
        return tuple(float(v) for v in self.params[4 : 4 + N_DISTORTION[self.model]])

    @property
    def K(self) -> Array:
        """Pinhole matrix (3, 3), px."""
        fx, fy, cx, cy = self.params[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def focal_px(self) -> float:
        return 0.5 * float(self.params[0] + self.params[1])

    def project(self, X_cam: Array) -> tuple[Array, Bools]:
        """(N, 3) m in the camera frame to (N, 2) px, and which of them the lens sees inside the image."""
        px, seen = project_points(self.model, self.params, np.ascontiguousarray(X_cam, dtype=np.float64))
        return px, seen & self.inside(px)

    def unproject(self, px: Array) -> tuple[Array, Bools]:
        """(N, 2) px to (N, 3) unit rays in the camera frame, and which pixels have one."""
        return unproject_points(self.model, self.params, np.ascontiguousarray(px, dtype=np.float64))

    def resized(self, factor: float) -> Camera:
        """The camera whose images are this one's resized, to whole pixels."""
        width, height = round(self.width * factor), round(self.height * factor)
        share = np.array([width / self.width, height / self.height])
        params = self.params.copy()
        params[:2] *= share
        params[2:4] = (params[2:4] + 0.5) * share - 0.5
        return Camera(self.model, width, height, params)

    def inside(self, px: Array, margin_px: float = 0.0) -> Bools:
        """Which (N, 2) px lie in the image; a pixel covers half a pixel around its centre."""
        lo, hi_u, hi_v = margin_px - 0.5, self.width - 0.5 - margin_px, self.height - 0.5 - margin_px
        u, v = px[:, 0], px[:, 1]
        return (u >= lo) & (u < hi_u) & (v >= lo) & (v < hi_v)
