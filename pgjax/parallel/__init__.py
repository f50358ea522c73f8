"""One scene over several devices."""

from pgjax._across import total as total
from pgjax.parallel.shared import SharedGrid as SharedGrid
from pgjax.parallel.simulate import simulate as simulate
from pgjax.parallel.slabs import Slabs as Slabs
