"""The particles of all models of a scene file, and which of them its parts take."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from pgjax.render import Gaussians, concatenate
from pgjax.scenes.arrays import require_lengths
from pgjax.scenes.capture import Body
from pgjax.scenes.model import ModelPart
from pgjax.scenes.reader import SceneError
from pgjax.scenes.regions import Points, Selection


@dataclasses.dataclass(frozen=True)
class Crowd:
    """All particles, of one model after the other or in another order.

    Attributes:
        models: the models of the scene file, m of them.
        bodies: what became of each.
        gaussians: what is drawn of them, in simulation coordinates: one for each particle, in
            their order, as long as none were merged or cut up (`merging`).
        x: positions, m, `(n, 3)`.
        rows: which Gaussian of its model's file each is or comes from, `(n,)`.
        body: of which model each is, `(n,)`.
        volumes: rest volumes, m³, `(n,)`.
    """

    models: tuple[ModelPart, ...]
    bodies: tuple[Body, ...]
    gaussians: Gaussians
    x: np.ndarray
    rows: np.ndarray
    body: np.ndarray
    volumes: np.ndarray

    @classmethod
    def of(cls, models: tuple[ModelPart, ...], bodies: Sequence[Body]) -> "Crowd":
        """The particles of one model after the other."""
        gaussians = concatenate([b.moving for b in bodies])
        return cls(
            models=models,
            bodies=tuple(bodies),
            gaussians=gaussians,
            x=np.asarray(gaussians.means),
            rows=np.concatenate([b.rows for b in bodies]),
            body=np.repeat(np.arange(len(bodies)), [len(b.rows) for b in bodies]),
            volumes=np.concatenate([b.volumes for b in bodies]),
        )

    def ordered(self, order: np.ndarray) -> "Crowd":
        """The same particles, a Gaussian each, in another order."""
        return dataclasses.replace(
            self,
            gaussians=self.gaussians[jnp.asarray(order)],
            x=self.x[order],
            rows=self.rows[order],
            body=self.body[order],
            volumes=self.volumes[order],
        )

    def taken(self, takes: Selection) -> np.ndarray:
        """Which particles are of the model and in the region of a selection, boolean `(n,)`.

        Raises:
            SceneError: a file of the table has not one value for each Gaussian of the model.
        """
        names = [model.name for model in self.models]
        index = 0 if takes.model is None else names.index(takes.model)
        require_lengths(takes.lengths, self.bodies[index].file_count, self.models[index].source)
        mask = np.ones(len(self.rows), bool) if takes.model is None else self.body == index
        if takes.region is not None:
            mask[mask] = takes.region.contains(Points(self.x[mask], self.rows[mask]))
        return mask

    def velocities(self) -> tuple[np.ndarray, np.ndarray]:
        """Velocities `(n, 3)` and their gradients `(n, 3, 3)` of bodies that fly and spin."""
        x, v, C = self.x.astype(np.float64), np.zeros((len(self.rows), 3)), []
        for index, model in enumerate(self.models):
            mine = self.body == index
            center = np.average(x[mine], axis=0, weights=self.volumes[mine])
            spin = np.asarray(model.angular_velocity)
            v[mine] = np.asarray(model.velocity) + np.cross(spin, x[mine] - center)
            C.append(np.cross(np.eye(3), spin))
        return v, np.stack(C)[self.body]


def by_material(crowd: Crowd, selections: Sequence[Selection]) -> tuple[Crowd, tuple[int, ...]]:
    """Order the particles so that each material owns a slice; the first that takes one owns it.

    Returns:
        The particles in their new order, and how many each material owns.
    """
    owner = np.full(len(crowd.rows), -1)
    for index, takes in enumerate(selections):
        owner[(owner < 0) & crowd.taken(takes)] = index
    homeless = int((owner < 0).sum())
    if homeless:
        raise SceneError(
            f"{selections[-1].name}: {homeless} particles are in the region of no [[material]]; "
            f"leave out `region` in the last one."
        )
    counts = np.bincount(owner, minlength=len(selections))
    for takes, count in zip(selections, counts, strict=True):
        if count == 0:
            raise SceneError(f"{takes.name} owns no particle: move its region.")
    return crowd.ordered(np.argsort(owner, kind="stable")), tuple(int(c) for c in counts)
