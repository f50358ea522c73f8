"""pgjax: a differentiable Material Point Method simulator for scenes captured as Gaussians."""

from typing import TYPE_CHECKING, Any

from pgjax.grid import Grid as Grid
from pgjax.ledger import Ledger as Ledger
from pgjax.result import Condition as Condition
from pgjax.result import SimulationError as SimulationError
from pgjax.result import SimulationWarning as SimulationWarning
from pgjax.result import Status as Status
from pgjax.scene import Scene as Scene
from pgjax.scene import initial_state as initial_state
from pgjax.simulate import Kinematics as Kinematics
from pgjax.simulate import Trajectory as Trajectory
from pgjax.simulate import simulate as simulate
from pgjax.splines import BSpline as BSpline
from pgjax.state import State as State
from pgjax.step import step as step
from pgjax.storage import load_state as load_state
from pgjax.storage import load_trajectory as load_trajectory
from pgjax.storage import save_state as save_state
from pgjax.storage import save_trajectory as save_trajectory
from pgjax.timestep import stable_dt as stable_dt
from pgjax.transfer import MLS as MLS
from pgjax.transfer import SplineGradient as SplineGradient

if TYPE_CHECKING:
    from pgjax.sweeps import sweep as sweep

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """`pgjax.sweep`, which takes as long to import as all the rest, at its first use."""
    if name == "sweep":
        from pgjax.sweeps import sweep

        return sweep
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
