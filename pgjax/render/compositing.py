"""Compositing splats front to back in plain JAX: what the native kernels do, with static shapes.

Splats are listed tile by tile, each tile's list is cut into work items, and the items are
composited side by side. The lists have a fixed length; if it is too short, the result is NaN.
"""

import jax
import jax.numpy as jnp

from pgjax import native
from pgjax._types import Array, Bool, Float, Int
from pgjax.render.tiles import TileGrid, count_pairs, list_pairs, work_items

Limits = Float[Array, "4"]

# Pairs in one work item, and pixels composited together.
_ITEM = 32
_PIXELS = 65536


def default_capacity(number: int, width: int, height: int) -> int:
    """Length of the lists where nothing is known: a million pairs or 16 a splat, or all there are.

    What a small scene can need at most is never exceeded.
    """
    return max(1, min(number * TileGrid.of(width, height).count, max(2**20, 16 * number)))


def sort_splats(
    limits: Limits,
    shape: Float[Array, "n 6"],
    values: Float[Array, "n k"],
    key: Float[Array, " n"],
) -> tuple[Float[Array, "m 6"], Float[Array, "m k"], Float[Array, " m"]]:
    """Splats front to back, and `log(opacity / alpha_min)`: negative for those not drawn, behind.

    What is not drawn gets opacity 0 and a harmless shape: none of its numbers is seen again. There
    is always at least one splat.
    """
    if shape.shape[0] == 0:
        shape, values = (jnp.zeros((1, a.shape[1]), a.dtype) for a in (shape, values))
        key = jnp.zeros(1, key.dtype)
    sound = jnp.all(jnp.isfinite(shape), axis=1) & (shape[:, 3] > 0) & (shape[:, 4] > 0)
    visible = sound & (shape[:, 5] >= limits[1]) & ~jnp.isnan(key)
    order = jnp.argsort(jnp.where(visible, key, jnp.inf), stable=True)
    visible = visible[order]
    harmless = jnp.asarray([[0, 0, 0, 1, 1, 0]], shape.dtype)
    shape = jnp.where(visible[:, None], shape[order], harmless)
    values = jnp.where(visible[:, None], values[order], 0)
    ratio = jnp.where(visible, shape[:, 5], limits[1]) / limits[1]
    return shape, values, jnp.where(visible, jnp.log(ratio), -1)


def needed_capacity(
    limits: Limits, shape: Float[Array, "n 6"], key: Float[Array, " n"], *, width: int, height: int
) -> Int[Array, ""]:
    """How long the lists must be."""
    empty = jnp.zeros((shape.shape[0], 0), shape.dtype)
    shape, _, reach = sort_splats(limits, shape, empty, key)
    return count_pairs(shape, reach, TileGrid.of(width, height))


def composite(
    limits: Limits,
    shape: Float[Array, "n 6"],
    values: Float[Array, "n k"],
    key: Float[Array, " n"],
    *,
    width: int,
    height: int,
    capacity: int,
) -> tuple[Float[Array, "h w k"], Float[Array, "h w"], Int[Array, ""]]:
    """`Σ w c` and `Σ w` at each pixel, and how many pairs (splat, tile) there are.

    Args:
        limits: alpha_max, alpha_min, stop, and 1 for the smooth cutoff (else 0).
        shape: u, v, m, p, q and opacity of each splat: `σ = p (dx − m dy)² + q dy²`.
        values: what is accumulated.
        key: what the splats are sorted by; equal ones stay in their order.
        width: columns of the image.
        height: rows of the image.
        capacity: length of the lists; NaN everywhere if more pairs are needed.
    """
    grid = TileGrid.of(width, height)
    shape, values, reach = sort_splats(limits, shape, values, key)
    fixed = jax.lax.stop_gradient((shape, reach))
    needed = count_pairs(*fixed, grid)
    tile, splat = list_pairs(*fixed, grid, capacity)
    sums = _over_items(limits, _table(shape, values), tile, splat, grid)
    sums = sums * jnp.where(needed > capacity, jnp.nan, 1).astype(sums.dtype)
    image = sums.reshape(grid.rows, grid.columns, -1, grid.tile, grid.tile)
    image = image.transpose(0, 3, 1, 4, 2).reshape(grid.rows * grid.tile, -1, sums.shape[1])
    image = image[:height, :width]
    return image[..., :-1], image[..., -1], needed


def _table(shape: Float[Array, "n 6"], values: Float[Array, "n k"]) -> Float[Array, "rows row"]:
    """One row per splat: shape, values and a 1; a last row that is invisible."""
    rows = jnp.concatenate([shape, values, jnp.ones_like(shape[:, :1])], axis=1)
    return jnp.pad(rows, ((0, 1), (0, 0)))


def _over_items(
    limits: Limits,
    table: Float[Array, "rows row"],
    tile: Int[Array, " c"],
    splat: Int[Array, " c"],
    grid: TileGrid,
) -> Float[Array, "tiles sum p"]:
    """The sums of all tiles: work items in batches, of which only the used ones cost time."""
    batch = _PIXELS // grid.tile**2
    steps = -(-(tile.shape[0] // _ITEM + grid.count) // batch)
    owner, places = work_items(tile, grid, _ITEM, steps * batch)
    member = jnp.concatenate([splat, jnp.full(1, table.shape[0] - 1, splat.dtype)])[places]
    begins = jnp.diff(owner, prepend=-1) != 0
    pixels = grid.tile**2
    sums = jnp.zeros((grid.count, table.shape[1] - 6, pixels), table.dtype)

    def add(state: tuple[Array, Array], items: tuple[Array, Array, Array]):
        """What a batch of items adds to the tiles; nothing where only padding is left."""

        def some(state: tuple[Array, Array]) -> tuple[Array, Array]:
            carry, sums = state
            owner, member, begins = items
            weighted, carry = jax.checkpoint(_composite_items, static_argnums=(6,))(
                table, member, owner, begins, carry, limits, grid
            )
            return carry, sums.at[owner].add(weighted, mode="drop")

        return jax.lax.cond(items[0][0] < grid.count, some, lambda state: state, state), None

    def batches(a: Array) -> Array:
        return a.reshape(steps, batch, *a.shape[1:])

    parts = (batches(owner), batches(member), batches(begins))
    _, ones, sums = native.varying(table, jnp.ones(pixels, table.dtype), sums)
    (_, sums), _ = jax.lax.scan(add, (ones, sums), parts)
    return sums


def alphas(
    limits: Limits, splat: Float[Array, "b row"], corner: Float[Array, "b 2"], tile: int
) -> Float[Array, "b p"]:
    """Alpha of one splat per work item at the pixels of its tile; 0 where it is not drawn."""
    alpha_max, alpha_min, _, smooth = limits
    pixel = jnp.arange(tile * tile)
    offset = jnp.stack([pixel % tile, pixel // tile]).astype(splat.dtype) + 0.5
    shift = corner - splat[:, :2]
    dx = shift[:, 0, None] + offset[None, 0]
    dy = shift[:, 1, None] + offset[None, 1]
    m, p, q, opacity = (splat[:, i, None] for i in range(2, 6))
    sheared = dx - m * dy
    raw = opacity * jnp.exp(-(p * sheared * sheared + q * dy * dy))
    alpha = jnp.where(raw < alpha_max, raw, alpha_max)
    t = jnp.clip(alpha / alpha_min - 1, 0, 1)
    ramp = jnp.where(smooth > 0, t * t * (3 - 2 * t), 1)
    return jnp.where(alpha >= alpha_min, alpha * ramp, 0)


def _composite_items(
    table: Float[Array, "rows row"],
    member: Int[Array, "b item"],
    owner: Int[Array, " b"],
    begins: Bool[Array, " b"],
    carry: Float[Array, " p"],
    limits: Limits,
    grid: TileGrid,
) -> tuple[Float[Array, "b sum p"], Float[Array, " p"]]:
    """Composite a batch of work items in two passes.

    First the transmittance of each item on its own, whose running product over the items of a tile
    gives the transmittance T before each item; then the weighted sums, with the ray ending where T
    *without* the early end has sunk to the bound. (As T only falls, that is the same place.)

    Args:
        table: one row per splat.
        member: rows of the table, front to back.
        owner: tile of each item.
        begins: whether an item is the first of its tile.
        carry: transmittance of the tile's earlier items, for an item that is first here only.
        limits: alpha_max, alpha_min, stop, smooth.
        grid: the tiles.

    Returns:
        `Σ w (c, 1)` of each item, and the transmittance after the last one.
    """
    corner = jnp.stack([owner % grid.columns, owner // grid.columns], -1) * grid.tile
    corner = corner.astype(table.dtype)
    steps = member.T

    def alpha_of(index: Int[Array, " b"]) -> tuple[Array, Array]:
        splat = table[index]
        return alphas(limits, splat, corner, grid.tile), splat[:, 6:, None]

    @jax.checkpoint
    def absorb(T, index):
        return T * (1 - alpha_of(index)[0]), None

    @jax.checkpoint
    def add(state, index):
        T, sums = state
        alpha, values = alpha_of(index)
        after = T * (1 - alpha)
        weight = jnp.where(after > limits[2], T * alpha, 0)
        return (after, sums + weight[:, None] * values), None

    b, pixels = member.shape[0], grid.tile**2
    ones = jnp.ones((b, pixels), table.dtype)
    zeros = jnp.zeros((b, table.shape[1] - 6, pixels), table.dtype)
    _, ones, zeros = native.varying(table, ones, zeros)
    T, _ = jax.lax.scan(absorb, ones, steps)
    before, last = _running_product(T, begins, carry)
    (_, sums), _ = jax.lax.scan(add, (before, zeros), steps)
    return sums, last


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
