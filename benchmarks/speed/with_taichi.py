"""The block in Taichi: MLS-MPM with quadratic splines.

The particles are one array of records. The stress is computed where F is known, at the end of a
step and in parallel, so that only the sums over particles remain for the serialised loop.
"""

# The bodies of kernels are Taichi's language: operators and indices as it defines them.
# pyright: reportOperatorIssue=none, reportIndexIssue=none

import os

import numpy as np
import taichi as ti

from benchmarks.speed import cases
from benchmarks.speed.cases import Case


@ti.func
def identity():
    """The 3×3 identity."""
    return ti.Matrix.identity(ti.f32, 3)


@ti.func
def weights(offset):
    """Quadratic weights of three nodes; `offset` in [½, 3/2) from the first of them."""
    return [
        0.5 * (1.5 - offset) ** 2,
        0.75 - (offset - 1.0) ** 2,
        0.5 * (offset - 0.5) ** 2,
    ]


@ti.func
def diagonal(e):
    """The diagonal matrix of a vector."""
    return ti.Matrix([[e[0], 0.0, 0.0], [0.0, e[1], 0.0], [0.0, 0.0, e[2]]])


@ti.func
def neo_hookean(F):
    """`τ = μ (F Fᵀ − I) + λ log J I`."""
    return (
        cases.MU * (F @ F.transpose() - identity())
        + cases.LAM * ti.log(F.determinant()) * identity()
    )


@ti.func
def fixed_corotated(F):
    """`τ = 2μ (F − R) Fᵀ + λ J (J − 1) I`."""
    U, _, V = ti.svd(F, ti.f32)
    J = F.determinant()
    shear = 2 * cases.MU * (F - U @ V.transpose()) @ F.transpose()
    return shear + cases.LAM * J * (J - 1) * identity()


@ti.func
def drucker_prager(e):
    """Hencky strain on or inside the cone."""
    trace = e.sum()
    shear = e - trace / 3
    norm = shear.norm()
    dgamma = norm + cases.ALPHA * (3 * cases.LAM + 2 * cases.MU) / (2 * cases.MU) * trace
    new = e
    if trace > 0:
        new = ti.Vector([0.0, 0.0, 0.0])
    elif dgamma > 0:
        new = e - dgamma / norm * shear
    return new


@ti.func
def von_mises(e):
    """Hencky strain whose deviator is at most `τ_Y/(2μ)`."""
    shear = e - e.sum() / 3
    norm = shear.norm()
    dgamma = norm - cases.YIELD_STRESS / (2 * cases.MU)
    new = e
    if dgamma > 0:
        new = e - dgamma / norm * shear
    return new


@ti.func
def hencky_stress(U, e):
    """`τ = U (2μ ε + λ tr ε) Uᵀ`."""
    return U @ diagonal(2 * cases.MU * e + cases.LAM * e.sum()) @ U.transpose()


@ti.func
def strained(law: ti.template(), F):
    """F after the return mapping of the law, and the Kirchhoff stress.

    Flow turns F into `U exp(Δε) Uᵀ F`, written on the change: rounding in U is scaled by Δε.
    """
    tau = identity()
    if ti.static(law == "neo-Hookean"):
        tau = neo_hookean(F)
    elif ti.static(law == "fixed corotated"):
        tau = fixed_corotated(F)
    else:
        U, S, _ = ti.svd(F, ti.f32)
        trial = ti.log(ti.Vector([S[0, 0], S[1, 1], S[2, 2]]))
        e = trial
        if ti.static(law == "Drucker-Prager"):
            e = drucker_prager(trial)
        elif ti.static(law == "von Mises"):
            e = von_mises(trial)
        F += U @ diagonal(ti.exp(e - trial) - 1) @ U.transpose() @ F
        tau = hencky_stress(U, e)
    return F, tau


@ti.data_oriented
class Solver:
    """The same run as often as it is asked for; `variant` is "serialised" or "atomics"."""

    def __init__(self, case: Case, variant: str):
        threads = len(os.sched_getaffinity(0))
        ti.init(arch=ti.cpu, cpu_max_num_threads=threads, offline_cache=False, log_level=ti.ERROR)
        self.law, self.cells, self.particles = case.material, case.cells, case.particles
        plastic = case.material not in ("neo-Hookean", "fixed corotated")
        self.first_law = "elastic Hencky" if plastic else case.material
        self.serialised = variant == "serialised"
        self.volume, self.mass = case.volume, case.volume * cases.DENSITY
        self.x, self.v = (ti.Vector.field(3, ti.f32) for _ in range(2))
        self.C, self.F, self.tau = (ti.Matrix.field(3, 3, ti.f32) for _ in range(3))
        particles = (self.x, self.v, self.C, self.F, self.tau)
        ti.root.dense(ti.i, case.particles).place(*particles)
        self.momentum, self.node_mass = ti.Vector.field(3, ti.f32), ti.field(ti.f32)
        ti.root.dense(ti.ijk, case.cells).place(self.momentum, self.node_mass)
        self.start = cases.start(case)

    def reset(self) -> None:
        """Back to the initial state."""
        self.x.from_numpy(self.start.x)
        self.v.from_numpy(self.start.v)
        self.F.from_numpy(self.start.F)
        self.C.fill(0)
        self.first_stress()
        ti.sync()

    def run(self, steps: int) -> None:
        """Advance, and wait for the result."""
        for _ in range(steps):
            self.step()
        ti.sync()

    def positions(self) -> np.ndarray:
        """Positions, m, `(p, 3)`."""
        return self.x.to_numpy()

    @ti.kernel
    def first_stress(self):
        """The stress of the initial F, which no return mapping touches."""
        for p in range(self.particles):
            self.F[p], self.tau[p] = strained(self.first_law, self.F[p])

    @ti.kernel
    def step(self):
        """One time step."""
        for I in ti.grouped(self.node_mass):
            self.momentum[I] = ti.Vector([0.0, 0.0, 0.0])
            self.node_mass[I] = 0.0

        ti.loop_config(serialize=self.serialised)
        for p in range(self.particles):
            base = ti.floor(self.x[p] / cases.H - 0.5, ti.i32)
            offset = self.x[p] / cases.H - base
            w = weights(offset)
            affine = self.mass * self.C[p] - (4 * cases.DT * self.volume / cases.H**2) * self.tau[p]
            momentum = self.mass * self.v[p]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                weight = w[i][0] * w[j][1] * w[k][2]
                away = (ti.Vector([i, j, k]) - offset) * cases.H
                self.momentum[base + ti.Vector([i, j, k])] += weight * (momentum + affine @ away)
                self.node_mass[base + ti.Vector([i, j, k])] += weight * self.mass

        for I in ti.grouped(self.node_mass):
            mass = self.node_mass[I]
            if mass > 0:
                v = self.momentum[I] / mass + cases.DT * ti.Vector(cases.GRAVITY)
                for d in ti.static(range(3)):
                    if I[d] <= cases.WALL or I[d] >= self.cells - cases.WALL:
                        v[d] = 0.0
                self.momentum[I] = v

        for p in range(self.particles):
            base = ti.floor(self.x[p] / cases.H - 0.5, ti.i32)
            offset = self.x[p] / cases.H - base
            w = weights(offset)
            v = ti.Vector([0.0, 0.0, 0.0])
            moment = ti.Matrix.zero(ti.f32, 3, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                weight = w[i][0] * w[j][1] * w[k][2]
                node = weight * self.momentum[base + ti.Vector([i, j, k])]
                v += node
                moment += node.outer_product(ti.Vector([i, j, k]) - offset)
            C = moment * (4 / cases.H)
            self.v[p] = v
            self.C[p] = C
            self.x[p] += cases.DT * v
            F = (identity() + cases.DT * C) @ self.F[p]
            self.F[p], self.tau[p] = strained(self.law, F)
