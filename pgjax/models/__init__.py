"""Constitutive laws: a material sees one deformation gradient and nothing of the grid."""

from pgjax._types import parameter as parameter
from pgjax.models.active import ActiveStress as ActiveStress
from pgjax.models.elasticity import DevVolNeoHookean as DevVolNeoHookean
from pgjax.models.elasticity import FixedCorotated as FixedCorotated
from pgjax.models.elasticity import NeoHookean as NeoHookean
from pgjax.models.elasticity import StVKHencky as StVKHencky
from pgjax.models.fluid import Fluid as Fluid
from pgjax.models.fluid import VolumeOnly as VolumeOnly
from pgjax.models.law import AbstractElasticity as AbstractElasticity
from pgjax.models.law import AbstractLaw as AbstractLaw
from pgjax.models.material import Material as Material
from pgjax.models.plasticity import AbstractHenckyPlasticity as AbstractHenckyPlasticity
from pgjax.models.plasticity import AbstractPlasticity as AbstractPlasticity
from pgjax.models.plasticity import DruckerPrager as DruckerPrager
from pgjax.models.plasticity import VonMises as VonMises
from pgjax.models.snow import CriticalStretches as CriticalStretches
from pgjax.models.snow import Snow as Snow
from pgjax.models.viscoplasticity import HerschelBulkley as HerschelBulkley
from pgjax.models.viscous import KelvinVoigt as KelvinVoigt
