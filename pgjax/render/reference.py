"""The definition of an image of Gaussians, evaluated pixel by pixel in double precision.

Slow and plain on purpose: the textbook formulas in the order in which they are usually written, in
numpy, without tiles. `rasterize` is tested against it.
"""

import numpy as np

from pgjax.render.camera import Camera, Triple
from pgjax.render.gaussians import Gaussians
from pgjax.render.harmonics import basis
from pgjax.render.rules import RULE_3DGS, Rule


def render_reference(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Triple = (0.0, 0.0, 0.0),
    rule: Rule = RULE_3DGS,
    antialiased: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour (h, w, 3), opacity (h, w) and accumulated depth (h, w) in double precision."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    T, running = np.ones_like(x), np.ones_like(x, dtype=bool)
    rgb, depth = np.zeros((*x.shape, 3)), np.zeros_like(x)
    for center, A, opacity, color, Z in _splats(gaussians, camera, rule, antialiased):
        d = np.stack([x - center[0], y - center[1]], axis=-1)
        sigma = 0.5 * np.einsum("hwi,ij,hwj->hw", d, np.linalg.inv(A), d)
        alpha = np.minimum(rule.alpha_max, opacity * np.exp(-sigma))
        drawn = running & (sigma >= 0) & (alpha >= rule.alpha_min)
        if rule.smooth:
            t = np.clip(alpha / rule.alpha_min - 1, 0, 1)
            alpha = alpha * t * t * (3 - 2 * t)
        running &= ~(drawn & (T * (1 - alpha) <= rule.stop))
        drawn &= running
        weight = np.where(drawn, T * alpha, 0)
        rgb += weight[..., None] * color
        depth += weight * Z
        T = np.where(drawn, T * (1 - alpha), T)
    return rgb + T[..., None] * np.asarray(background), 1 - T, depth


def _splats(
    gaussians: Gaussians, camera: Camera, rule: Rule, antialiased: bool
) -> list[tuple[np.ndarray, np.ndarray, float, np.ndarray, float]]:
    """Centre, 2×2 covariance, opacity, colour and depth of what lies in front, front to back."""
    W = np.asarray(camera.world_to_camera, dtype=np.float64)
    means = np.asarray(gaussians.means, dtype=np.float64)
    in_camera = means @ W[:3, :3].T + W[:3, 3]
    position = -W[:3, :3].T @ W[:3, 3]
    splats = []
    order = np.argsort(in_camera[:, 2], kind="stable")
    for i in map(int, order[in_camera[order, 2] > float(camera.near)]):
        X, Y, Z = in_camera[i]
        M = np.asarray(gaussians.factors[i], dtype=np.float64)
        J = _jacobian(X, Y, Z, camera)
        sharp = J @ W[:3, :3] @ M @ M.T @ W[:3, :3].T @ J.T
        A = sharp + rule.low_pass * np.eye(2)
        opacity = float(gaussians.opacities[i])
        if antialiased:
            opacity *= max(np.linalg.det(sharp) / np.linalg.det(A), 0.005**2) ** 0.5
        center = np.array(
            [
                float(camera.fx) * X / Z + float(camera.cx),
                float(camera.fy) * Y / Z + float(camera.cy),
            ]
        )
        splats.append((center, A, opacity, _color(gaussians, i, means[i] - position), Z))
    return splats


def _jacobian(X: float, Y: float, Z: float, camera: Camera) -> np.ndarray:
    """Derivative of the pixel position, at a direction at most 0.3 tan(fov/2) outside the frame."""
    rows = []
    for axis, (along, f, c, size) in enumerate(
        [(X, camera.fx, camera.cx, camera.width), (Y, camera.fy, camera.cy, camera.height)]
    ):
        f, c = float(f), float(c)
        margin = 0.3 * (size / 2) / f
        ratio = min(max(along / Z, -c / f - margin), (size - c) / f + margin)
        row = np.zeros(3)
        row[axis], row[2] = f / Z, -f * ratio / Z
        rows.append(row)
    return np.array(rows)


def _color(gaussians: Gaussians, i: int, offset: np.ndarray) -> np.ndarray:
    direction = offset / max(np.linalg.norm(offset), 1e-300)
    turned = np.asarray(gaussians.frames[i], dtype=np.float64).T @ direction
    values = basis(turned, gaussians.degree) @ np.asarray(gaussians.sh[i], dtype=np.float64)
    return np.maximum(values + 0.5, 0)
