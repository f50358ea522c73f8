"""The block in NVIDIA Warp, whose CPU kernels run on one thread: MLS-MPM, quadratic splines."""

# The bodies of kernels are Warp's language: operators and indices as it defines them.
# pyright: reportArgumentType=none, reportOperatorIssue=none, reportIndexIssue=none
# pyright: reportAssignmentType=none, reportGeneralTypeIssues=none

import tempfile

import numpy as np
import warp as wp

from benchmarks.speed import cases
from benchmarks.speed.cases import Case

wp.config.log_level = wp.LOG_ERROR
wp.config.enable_backward = False
wp.config.optimization_level = 3

MU, LAM = wp.constant(cases.MU), wp.constant(cases.LAM)
YIELD_STRAIN = wp.constant(cases.YIELD_STRESS / (2 * cases.MU))
CONE = wp.constant(cases.ALPHA * (3 * cases.LAM + 2 * cases.MU) / (2 * cases.MU))
GRAVITY = wp.constant(wp.vec3(*cases.GRAVITY))
H, DT, WALL = wp.constant(cases.H), wp.constant(cases.DT), wp.constant(cases.WALL)


@wp.struct
class Strained:
    """F after the return mapping, and the Kirchhoff stress."""

    F: wp.mat33
    tau: wp.mat33


@wp.func
def identity():
    """The 3×3 identity."""
    return wp.identity(n=3, dtype=float)


@wp.func
def neo_hookean(F: wp.mat33):
    """`τ = μ (F Fᵀ − I) + λ log J I`."""
    s = Strained()
    s.F = F
    s.tau = MU * (F * wp.transpose(F) - identity()) + LAM * wp.log(wp.determinant(F)) * identity()
    return s


@wp.func
def fixed_corotated(F: wp.mat33):
    """`τ = 2μ (F − R) Fᵀ + λ J (J − 1) I`."""
    U, _sigma, V = wp.svd3(F)
    J = wp.determinant(F)
    s = Strained()
    s.F = F
    s.tau = 2.0 * MU * (F - U * wp.transpose(V)) * wp.transpose(F)
    s.tau += LAM * J * (J - 1.0) * identity()
    return s


@wp.func
def mean(e: wp.vec3):
    """A vector of three times the mean of the entries."""
    m = (e[0] + e[1] + e[2]) / 3.0
    return wp.vec3(m, m, m)


@wp.func
def elastic_strain(e: wp.vec3):
    """Hencky strain that never flows."""
    return e


@wp.func
def drucker_prager(e: wp.vec3):
    """Hencky strain on or inside the cone."""
    shear = e - mean(e)
    trace = e[0] + e[1] + e[2]
    norm = wp.length(shear)
    dgamma = norm + CONE * trace
    if trace > 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if dgamma > 0.0:
        return e - dgamma / norm * shear
    return e


@wp.func
def von_mises(e: wp.vec3):
    """Hencky strain whose deviator is at most `τ_Y/(2μ)`."""
    shear = e - mean(e)
    norm = wp.length(shear)
    if norm > YIELD_STRAIN:
        return e - (norm - YIELD_STRAIN) / norm * shear
    return e


def hencky(flow):
    """The law with `τ = U (2μ ε + λ tr ε) Uᵀ` and a flow in principal Hencky strains.

    Flow turns F into `U exp(Δε) Uᵀ F`, written on the change: rounding in U is scaled by Δε.
    """

    @wp.func
    def law(F: wp.mat33):
        U, sigma, _V = wp.svd3(F)
        trial = wp.vec3(wp.log(sigma[0]), wp.log(sigma[1]), wp.log(sigma[2]))
        e = flow(trial)
        d = e - trial
        change = wp.vec3(wp.exp(d[0]) - 1.0, wp.exp(d[1]) - 1.0, wp.exp(d[2]) - 1.0)
        s = Strained()
        s.F = F + U * wp.diag(change) * wp.transpose(U) * F
        s.tau = U * wp.diag(2.0 * MU * e + 3.0 * LAM * mean(e)) * wp.transpose(U)
        return s

    return law


# The law of a step, and the law of the initial F, which no return mapping touches.
LAWS = {
    "neo-Hookean": (neo_hookean, neo_hookean),
    "fixed corotated": (fixed_corotated, fixed_corotated),
    "Drucker-Prager": (hencky(drucker_prager), hencky(elastic_strain)),
    "von Mises": (hencky(von_mises), hencky(elastic_strain)),
}


@wp.func
def weights(offset: wp.vec3):
    """Quadratic weights, a row per node; `offset` in [½, 3/2) from the first node."""
    a = wp.vec3(1.5, 1.5, 1.5) - offset
    b = offset - wp.vec3(1.0, 1.0, 1.0)
    c = offset - wp.vec3(0.5, 0.5, 0.5)
    return wp.matrix_from_rows(
        0.5 * wp.cw_mul(a, a),
        wp.vec3(0.75, 0.75, 0.75) - wp.cw_mul(b, b),
        0.5 * wp.cw_mul(c, c),
    )


@wp.func
def first_node(x: wp.vec3):
    """First node of a stencil."""
    return wp.vec3i(
        int(wp.floor(x[0] / H - 0.5)),
        int(wp.floor(x[1] / H - 0.5)),
        int(wp.floor(x[2] / H - 0.5)),
    )


@wp.kernel
def scatter(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    tau: wp.array(dtype=wp.mat33),
    volume: float,
    mass: float,
    nodes: wp.array3d(dtype=wp.vec4),
):
    """P2G: momentum and mass of the nodes."""
    p = wp.tid()
    base = first_node(x[p])
    offset = x[p] / H - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
    w = weights(offset)
    affine = mass * C[p] - (4.0 * DT * volume / (H * H)) * tau[p]
    momentum = mass * v[p]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                weight = w[i, 0] * w[j, 1] * w[k, 2]
                away = (wp.vec3(float(i), float(j), float(k)) - offset) * H
                part = weight * (momentum + affine * away)
                row = wp.vec4(part[0], part[1], part[2], weight * mass)
                wp.atomic_add(nodes, base[0] + i, base[1] + j, base[2] + k, row)


@wp.kernel
def move_nodes(nodes: wp.array3d(dtype=wp.vec4), cells: int):
    """Velocity, gravity and walls, in place of the momentum."""
    i, j, k = wp.tid()
    node = nodes[i, j, k]
    if node[3] > 0.0:
        v = wp.vec3(node[0], node[1], node[2]) / node[3] + DT * GRAVITY
        if i <= WALL or i >= cells - WALL:
            v[0] = 0.0
        if j <= WALL or j >= cells - WALL:
            v[1] = 0.0
        if k <= WALL or k >= cells - WALL:
            v[2] = 0.0
        nodes[i, j, k] = wp.vec4(v[0], v[1], v[2], node[3])


def kernels(material: str):
    """The kernels that hold the law: G2P, and the stress of the initial F."""
    law, first_law = LAWS[material]

    @wp.kernel(module="unique")
    def gather(
        nodes: wp.array3d(dtype=wp.vec4),
        x: wp.array(dtype=wp.vec3),
        v: wp.array(dtype=wp.vec3),
        C: wp.array(dtype=wp.mat33),
        F: wp.array(dtype=wp.mat33),
        tau: wp.array(dtype=wp.mat33),
    ):
        p = wp.tid()
        base = first_node(x[p])
        offset = x[p] / H - wp.vec3(float(base[0]), float(base[1]), float(base[2]))
        w = weights(offset)
        new = wp.vec3(0.0, 0.0, 0.0)
        moment = wp.mat33(0.0)
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    weight = w[i, 0] * w[j, 1] * w[k, 2]
                    node = nodes[base[0] + i, base[1] + j, base[2] + k]
                    part = weight * wp.vec3(node[0], node[1], node[2])
                    new += part
                    moment += wp.outer(part, wp.vec3(float(i), float(j), float(k)) - offset)
        gradient = moment * (4.0 / H)
        v[p] = new
        C[p] = gradient
        x[p] = x[p] + DT * new
        s = law((identity() + DT * gradient) * F[p])
        F[p] = s.F
        tau[p] = s.tau

    @wp.kernel(module="unique")
    def first_stress(F: wp.array(dtype=wp.mat33), tau: wp.array(dtype=wp.mat33)):
        p = wp.tid()
        s = first_law(F[p])
        tau[p] = s.tau

    return gather, first_stress


class Solver:
    """The same run as often as it is asked for; `variant` is not looked at."""

    def __init__(self, case: Case, variant: str):
        del variant
        wp.config.kernel_cache_dir = tempfile.mkdtemp()
        wp.init()
        self.case, self.start = case, cases.start(case)
        self.gather, self.first_stress = kernels(case.material)
        with wp.ScopedDevice("cpu"):
            self.nodes = wp.zeros((case.cells,) * 3, dtype=wp.vec4)
            self.tau = wp.zeros(case.particles, dtype=wp.mat33)
        self.reset()

    def reset(self) -> None:
        """Back to the initial state."""
        with wp.ScopedDevice("cpu"):
            self.x = wp.array(self.start.x, dtype=wp.vec3)
            self.v = wp.array(self.start.v, dtype=wp.vec3)
            self.F = wp.array(self.start.F, dtype=wp.mat33)
            self.C = wp.zeros(self.case.particles, dtype=wp.mat33)
            wp.launch(self.first_stress, self.case.particles, [self.F, self.tau])

    def run(self, steps: int) -> None:
        """Advance; on the CPU a launch returns when the kernel has run."""
        case, n = self.case, self.case.particles
        mass = case.volume * cases.DENSITY
        sent = [self.x, self.v, self.C, self.tau, case.volume, mass, self.nodes]
        received = [self.nodes, self.x, self.v, self.C, self.F, self.tau]
        with wp.ScopedDevice("cpu"):
            for _ in range(steps):
                self.nodes.zero_()
                wp.launch(scatter, n, sent)
                wp.launch(move_nodes, self.nodes.shape, [self.nodes, case.cells])
                wp.launch(self.gather, n, received)

    def positions(self) -> np.ndarray:
        """Positions, m, `(p, 3)`."""
        return self.x.numpy()
