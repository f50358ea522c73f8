"""Drawing Gaussians: project, list the splats of each tile, composite front to back."""

import functools
import warnings
from collections.abc import Iterator
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Float, require
from pgjax.render.camera import Camera, Triple
from pgjax.render.gaussians import Gaussians
from pgjax.render.projection import Splat, project
from pgjax.render.rules import RULE_3DGS, Rule
from pgjax.render.tiles import pairs, tile_spans, work_items

# Pairs in one work item, and items composited together: 1024 tiles of 16² pixels are 1 MB.
_ITEM = 32
_BATCH = 1024
# Below this image size small tiles cut the number of pixel–splat pairs three times.
_SMALL_IMAGE = 400


@final
class Image(eqx.Module):
    """A rendered image.

    Attributes:
        rgb: colour over the background; not bounded by 1.
        alpha: opacity, `Σ w` with the weights w of the Gaussians along each ray.
        depth: expected camera depth Z, `Σ w Z / Σ w` (0 where alpha is 0).
        depth_acc: accumulated depth `Σ w Z`.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    depth_acc: Float[Array, "h w"]


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Triple = (0.0, 0.0, 0.0),
    rule: Rule = RULE_3DGS,
    antialiased: bool = False,
) -> Image:
    """Draw Gaussians: `rgb = Σ w_i c_i + (1 − Σ w_i) background`, `w_i = α_i Π_{j<i} (1 − α_j)`.

    The image has the precision of the Gaussians. Gaussians that are not finite are left out with a
    warning. The number of splats per tile is not limited.

    Args:
        gaussians: what to draw.
        camera: from where.
        background: red, green, blue behind everything.
        rule: constants of the compositing.
        antialiased: dim small Gaussians by what the low-pass filter adds to their area.

    Reference: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
    ACM Transactions on Graphics 42(4), 2023; M. Zwicker et al., "EWA volume splatting", 2001.
    """
    dtype = gaussians.means.dtype
    behind = np.asarray(background, dtype=dtype)
    if behind.shape != (3,):
        raise ValueError(
            f"Argument `background` must be three numbers, but has shape {behind.shape}."
        )
    require("background", behind, "be finite", np.isfinite)
    splats = _visible_splats(gaussians, camera, rule, antialiased)
    sums = _composite(splats, camera, rule)
    rgb, alpha, depth_acc = sums[..., :3], sums[..., 3], sums[..., 4]
    depth = np.divide(depth_acc, alpha, out=np.zeros_like(alpha), where=alpha > 0)
    return Image(
        rgb=jnp.asarray(rgb + (1 - alpha[..., None]) * behind),
        alpha=jnp.asarray(alpha),
        depth=jnp.asarray(depth),
        depth_acc=jnp.asarray(depth_acc),
    )


_project = jax.jit(project, static_argnames="antialiased")


def _visible_splats(gaussians: Gaussians, camera: Camera, rule: Rule, antialiased: bool) -> Splat:
    """The splats that can reach alpha_min, front to back, as numpy arrays."""
    low_pass = jnp.asarray(rule.low_pass, dtype=gaussians.means.dtype)
    splats = jax.tree.map(
        np.asarray, _project(gaussians, camera, low_pass, antialiased=antialiased)
    )
    broken = np.count_nonzero(~splats.finite)
    if broken:
        warnings.warn(
            f"{broken} of {len(gaussians)} Gaussians are not finite, or overflow in "
            f"{gaussians.means.dtype}, and are not drawn.",
            stacklevel=3,
        )
    visible = np.flatnonzero(splats.opacity >= rule.alpha_min)
    order = visible[np.argsort(splats.depth[visible], kind="stable")]
    return jax.tree.map(lambda leaf: leaf[order], splats)


def _composite(splats: Splat, camera: Camera, rule: Rule) -> np.ndarray:
    """`Σ w (r, g, b, 1, Z)` at each pixel, of shape (height, width, 5)."""
    tile = 8 if max(camera.width, camera.height) < _SMALL_IMAGE else 16
    columns, rows = -(-camera.width // tile), -(-camera.height // tile)
    double = jax.tree.map(lambda leaf: leaf.astype(np.float64), splats)
    spans = tile_spans(
        double.center,
        double.variances,
        double.covariance,
        double.det,
        np.log(np.maximum(double.opacity / rule.alpha_min, 1)),
        tile=tile,
        columns=columns,
        rows=rows,
    )
    table = _table(splats)
    dtype = table.dtype
    limits = jnp.asarray([rule.alpha_max, rule.alpha_min, rule.stop], dtype=dtype)
    sums = np.zeros((columns * rows, 5, tile * tile), dtype=dtype)
    for splat, tiles in pairs(spans, columns=columns, rows=rows):
        carry = jnp.ones(tile * tile, dtype=dtype)
        for item_tile, member, begins in _batches(splat, tiles, len(table) - 1):
            corner = np.stack([item_tile % columns, item_tile // columns], -1) * tile
            weighted, carry = _composite_items(
                table[member], corner.astype(dtype), begins, carry, limits, tile=tile
            )
            _accumulate(sums, item_tile, np.asarray(weighted))
    image = sums.reshape(rows, columns, 5, tile, tile).transpose(0, 3, 1, 4, 2)
    image = image.reshape(rows * tile, columns * tile, 5)
    return image[: camera.height, : camera.width]


def _table(splats: Splat) -> np.ndarray:
    """One row (u, v, m, p, q, opacity, r, g, b, Z) per splat, and a last row that is invisible.

    `σ = p (dx − m dy)² + q dy²` with m = xy/yy, p = yy/(2 det), q = 1/(2 yy) is a sum of squares:
    even for a needle that crosses the whole image rounding leaves it positive and accurate.
    """
    yy = splats.variances[:, 1]
    columns = [
        *splats.center.T,
        splats.covariance / yy,
        yy / (2 * splats.det),
        1 / (2 * yy),
        splats.opacity,
        *splats.color.T,
        splats.depth,
    ]
    table = np.stack(columns, axis=-1)
    return np.concatenate([table, np.zeros((1, table.shape[1]), dtype=table.dtype)])


def _batches(
    splat: np.ndarray, tiles: np.ndarray, invisible: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Batches of work items: their tiles, their splats, and whether each begins a new tile.

    Batches are filled up with items of invisible splats, so that all have one shape and nothing is
    compiled twice. These belong to the last tile, whose transmittance they leave as it is.
    """
    item_tile, begin, end = work_items(tiles, _ITEM)
    new = np.diff(item_tile, prepend=-1) != 0
    for start in range(0, len(item_tile), _BATCH):
        part = slice(start, start + _BATCH)
        fill = max(start + _BATCH - len(item_tile), 0)
        index = begin[part, None] + np.arange(_ITEM)
        inside = index < end[part, None]
        member = np.where(inside, splat[np.where(inside, index, 0)], invisible)
        yield (
            np.pad(item_tile[part], (0, fill), mode="edge"),
            np.pad(member, ((0, fill), (0, 0)), constant_values=invisible),
            np.pad(new[part], (0, fill)),
        )


def _accumulate(sums: np.ndarray, item_tile: np.ndarray, weighted: np.ndarray) -> None:
    """Add the items' sums to those of their tiles (items of one tile are neighbours)."""
    first = np.flatnonzero(np.diff(item_tile, prepend=-1))
    sums[item_tile[first]] += np.add.reduceat(weighted, first, axis=0)


@functools.partial(jax.jit, static_argnames="tile")
def _composite_items(
    splats: Float[Array, "b item 10"],
    corner: Float[Array, "b 2"],
    begins: Bool[Array, " b"],
    carry: Float[Array, " p"],
    limits: Float[Array, "3"],
    *,
    tile: int,
) -> tuple[Float[Array, "b 5 p"], Float[Array, " p"]]:
    """Composite a batch of work items in two passes.

    First the transmittance of each item on its own, whose running product over the items of a tile
    gives the transmittance T before each item; then the weighted sums, with the ray ending where T
    *without* the early end has sunk to the bound. (As T only falls, that is the same place.)

    Args:
        splats: rows of the table.
        corner: upper left corner of each item's tile, in pixels.
        begins: whether an item is the first of its tile.
        carry: transmittance of the tile's earlier items, for an item that is first here only.
        limits: alpha_max, alpha_min and stop.
        tile: width of a tile in pixels.

    Returns:
        `Σ w (r, g, b, 1, Z)` of each item, and the transmittance after the last one.
    """
    alpha_max, alpha_min, stop = limits
    pixel = jnp.arange(tile * tile)
    offset = jnp.stack([pixel % tile, pixel // tile]).astype(splats.dtype) + 0.5
    steps = jnp.moveaxis(splats, 1, 0)

    def alphas(splat: Float[Array, "b 10"]) -> Float[Array, "b p"]:
        shift = corner - splat[:, :2]
        dx = shift[:, 0, None] + offset[None, 0]
        dy = shift[:, 1, None] + offset[None, 1]
        m, p, q, opacity = (splat[:, i, None] for i in range(2, 6))
        sheared = dx - m * dy
        alpha = jnp.minimum(opacity * jnp.exp(-(p * sheared * sheared + q * dy * dy)), alpha_max)
        return jnp.where(alpha >= alpha_min, alpha, 0)

    def absorb(T, splat):
        return T * (1 - alphas(splat)), None

    def add(state, splat):
        T, sums = state
        alpha = alphas(splat)
        after = T * (1 - alpha)
        weight = jnp.where(after > stop, T * alpha, 0)
        r, g, b, Z = (splat[:, i, None] for i in range(6, 10))
        sums = tuple(s + weight * c for s, c in zip(sums, (r, g, b, 1, Z), strict=True))
        return (after, sums), None

    ones = jnp.ones((splats.shape[0], tile * tile), dtype=splats.dtype)
    T, _ = jax.lax.scan(absorb, ones, steps, unroll=8)
    before, last = _running_product(T, begins, carry)
    (_, sums), _ = jax.lax.scan(add, (before, (0 * ones,) * 5), steps, unroll=8)
    return jnp.stack(sums, axis=1), last


def _running_product(
    T: Float[Array, "b p"], begins: Bool[Array, " b"], carry: Float[Array, " p"]
) -> tuple[Float[Array, "b p"], Float[Array, " p"]]:
    """For each row the product of the earlier rows of its tile, and that including the last row."""

    def combine(left, right):
        (new_left, T_left), (new_right, T_right) = left, right
        return new_left | new_right, jnp.where(new_right, T_right, T_left * T_right)

    first = jnp.where(begins[0], 1, carry)
    T = T.at[0].multiply(first)
    _, after = jax.lax.associative_scan(combine, (begins[:, None], T))
    shifted = jnp.concatenate([first[None], after[:-1]])
    return jnp.where(begins[:, None], 1, shifted), after[-1]
