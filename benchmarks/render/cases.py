"""Which images are measured. Nothing here needs JAX or PyTorch."""

import dataclasses
from pathlib import Path

# The file of each capture; the landscape is made.
FILES = {
    "playbot_1873": "playbot_1873.ply",
    "playbot_8406": "playbot_8406.ply",
    "playbot_31000": "playbot_31000.ply",
    "angel_71359": "angel_71359.ply",
    "guitar": "guitar.compressed.ply",
}
LANDSCAPE = "landscape"
SCENES = (*FILES, LANDSCAPE)
SIZES = (256, 800)
QUANTITIES = ("forward", "tangent", "gradient")


@dataclasses.dataclass(frozen=True)
class Case:
    """One image.

    Attributes:
        scene: a name of `SCENES`.
        size: rows and columns of the image.
        data: folder of the captures.
        side: Gaussians along an edge of the landscape.
    """

    scene: str
    size: int
    data: str = ""
    side: int = 1000

    @property
    def file(self) -> Path | None:
        """Where the capture is; None for the landscape."""
        return None if self.scene == LANDSCAPE else Path(self.data) / FILES[self.scene]
