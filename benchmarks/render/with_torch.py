"""The same in PyTorch: projection and harmonics of gsplat, in pure PyTorch, compositing here.

The picture is the same one: a Gaussian is drawn where its alpha is at least `ALPHA_MIN`, in the
order of depth, and a ray ends before the one that would take the transmittance to `STOP`. Tiles
have lists of what may touch them. All tiles advance together, by a few Gaussians at a time; those
whose list or whose rays have come to their end drop out. gsplat's own compositing needs CUDA.
"""

import math
import os
from typing import Any

import numpy as np
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _spherical_harmonics
from torch import Tensor
from torch.autograd import forward_ad

ALPHA_MAX, ALPHA_MIN, STOP, LOW_PASS = 0.99, 1 / 255, 1e-4, 0.3
BACKGROUND = 1.0
TILE = 8
# Gaussians by which every tile advances at a time.
CHUNK = 16
# Columns of a splat: 2, 3, 1, 3.
NAMES = ("center", "conic", "opacity", "color")
PARTS = ("means", "factors", "opacities", "sh")


def project(parts: dict[str, Tensor], camera: dict[str, Any]) -> dict[str, Tensor]:
    """What is drawn, front to back: centre, conic, opacity, colour, half width and height."""
    means, factors = parts["means"], parts["factors"]
    matrix, size = camera["world_to_camera"], camera["size"]
    covariances = factors @ factors.transpose(-1, -2)
    _, centers, depths, conics, _ = _fully_fused_projection(
        means,
        covariances,
        matrix[None],
        camera["intrinsics"][None],
        size,
        size,
        LOW_PASS,
        camera["near"],
    )
    position = -matrix[:3, :3].T @ matrix[:3, 3]
    degree = math.isqrt(parts["sh"].shape[1]) - 1
    colors = (_spherical_harmonics(degree, means - position, parts["sh"]) + 0.5).clamp(min=0)
    conics = conics[0]
    with torch.no_grad():
        # The ellipse of alpha_min, in a box; the covariance is the inverse of the conic.
        reach = 2 * torch.log(parts["opacities"] / ALPHA_MIN)
        det = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
        extent = torch.sqrt(reach[:, None] * conics[:, [2, 0]] / det[:, None]) * (1 + 1e-3) + 0.01
        seen = (depths[0] > camera["near"]) & (reach >= 0) & torch.isfinite(extent).all(-1)
        kept = torch.nonzero(seen)[:, 0]
        kept = kept[torch.argsort(depths[0, kept], stable=True)]
    found = {"center": centers[0], "conic": conics, "opacity": parts["opacities"], "color": colors}
    return {name: value[kept] for name, value in found.items()} | {"extent": extent[kept]}


def tile_lists(center: Tensor, extent: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Splats by tile in their order, and where each tile's begin and how many they are."""
    columns = -(-size // TILE)
    first = ((center - extent - 0.5) / TILE).floor().clamp(0, columns).long()
    last = ((center + extent - 0.5) / TILE).floor().clamp(-1, columns - 1).long()
    wide = (last - first + 1).clamp(min=0)
    count = wide[:, 0] * wide[:, 1]
    splat = torch.repeat_interleave(count)
    inside = torch.arange(len(splat)) - (count.cumsum(0) - count)[splat]
    x = first[splat, 0] + inside % wide[splat, 0]
    y = first[splat, 1] + inside // wide[splat, 0]
    tile, order = torch.sort(y * columns + x, stable=True)
    length = torch.bincount(tile, minlength=columns * columns)
    return splat[order], length.cumsum(0) - length, length


def composite(splats: dict[str, Tensor], size: int) -> Tensor:
    """The image, `(size, size, 3)`."""
    table = torch.cat([splats[name].reshape(len(splats["center"]), -1) for name in NAMES], dim=1)
    # A last row that draws nothing fills the lists up.
    table = torch.cat([table, table.new_zeros(1, table.shape[1])])
    with torch.no_grad():
        splat, begin, length = tile_lists(splats["center"].detach(), splats["extent"], size)
        length, tiles = torch.sort(length, descending=True)
        begin = begin[tiles]
        splat = torch.cat([splat, torch.tensor([len(table) - 1])])
    columns = -(-size // TILE)
    inner = torch.arange(TILE * TILE)
    x = (tiles % columns)[:, None] * TILE + inner % TILE + 0.5
    y = (tiles // columns)[:, None] * TILE + inner // TILE + 0.5
    # Red, green, blue and weight of the tiles that are still at work, in the places `on`.
    on = torch.arange(int((length > 0).sum()))
    sums, transmitted = torch.zeros(len(on), TILE**2, 4), torch.ones(len(on), TILE**2)
    places, results = (
        [torch.arange(len(on), len(tiles))],
        [torch.zeros(len(tiles) - len(on), TILE**2, 4)],
    )
    start = 0
    while len(on):
        index = start + torch.arange(CHUNK)
        index = torch.where(index < length[on, None], begin[on, None] + index, len(splat) - 1)
        rows = table[splat[index]]
        alpha = alphas(rows, x[on], y[on])
        after = transmitted[:, None] * torch.cumprod(1 - alpha, dim=1)
        before = torch.cat([transmitted[:, None], after[:, :-1]], dim=1)
        # Transmittances never rise: behind the end of a ray all are at most `stop`.
        going = after > STOP
        weight = torch.where(going, before * alpha, 0)
        values = torch.cat([rows[..., 6:], torch.ones_like(rows[..., :1])], dim=-1)
        sums = sums + weight.transpose(1, 2) @ values
        transmitted = torch.where(going[:, -1], after[:, -1], 0)
        start += CHUNK
        more = (length[on] > start) & (transmitted > 0).any(1)
        places.append(on[~more])
        results.append(sums[~more])
        on, sums, transmitted = on[more], sums[more], transmitted[more]
    order = torch.argsort(tiles[torch.cat(places)])
    tiled = torch.cat(results)[order].reshape(columns, columns, TILE, TILE, 4)
    image = tiled.transpose(1, 2).reshape(columns * TILE, columns * TILE, 4)[:size, :size]
    return image[..., :3] + (1 - image[..., 3:]) * BACKGROUND


def alphas(rows: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Of each splat in each pixel of its tile, `(tiles, splats, pixels)`."""
    u, v, a, b, c, opacity = rows[..., :6, None].unbind(2)
    dx, dy = x[:, None] - u, y[:, None] - v
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    return torch.where((alpha >= ALPHA_MIN) & (sigma >= 0), alpha, 0)


class Renderer:
    """Draws what pgjax has exported."""

    def __init__(self, file: str):
        torch.set_num_threads(len(os.sched_getaffinity(0)))
        data = {name: torch.from_numpy(value) for name, value in np.load(file).items()}
        self.parts = {part: data[part] for part in PARTS}
        self.camera = {name: data[name] for name in ("world_to_camera", "intrinsics")}
        self.camera |= {"near": float(data["near"]), "size": int(data["size"])}
        self.weights, self.direction = data["weights"], data["direction"]

    def image(self, parts: dict[str, Tensor]) -> Tensor:
        """Of Gaussians with these arrays."""
        return composite(project(parts, self.camera), self.camera["size"])

    def run(self, quantity: str) -> dict[str, Tensor]:
        """Once, to the end."""
        if quantity == "forward":
            with torch.no_grad():
                return {"forward": self.image(self.parts)}
        if quantity == "tangent":
            with torch.no_grad(), forward_ad.dual_level():
                means = forward_ad.make_dual(self.parts["means"], self.direction)
                value, tangent = forward_ad.unpack_dual(self.image(self.parts | {"means": means}))
                return {"forward": value, "tangent": tangent}
        parts = {name: value.detach().requires_grad_() for name, value in self.parts.items()}
        value = (self.weights * self.image(parts)).sum()
        value.backward()
        return {name: part.grad for name, part in parts.items()} | {"value": value.detach()}

    def save(self, result: dict[str, Tensor], file: str) -> None:
        """The result in numbers."""
        np.savez(file, **{name: value.numpy() for name, value in result.items()})
