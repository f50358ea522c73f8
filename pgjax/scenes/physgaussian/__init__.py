"""Scenes from PhysGaussian's configuration files; see `docs/physgaussian.md`.

Written from the meaning of the keys alone; no code of the reference is part of it.
"""

from pgjax.scenes.physgaussian.convert import Converted as Converted
from pgjax.scenes.physgaussian.convert import convert as convert
