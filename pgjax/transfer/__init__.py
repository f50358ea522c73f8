"""Particle–grid transfers."""

from pgjax.transfer.reference import Payload as Payload
from pgjax.transfer.reference import Stencil as Stencil
from pgjax.transfer.reference import gather as gather
from pgjax.transfer.reference import scatter as scatter
from pgjax.transfer.reference import stencil as stencil
from pgjax.transfer.scheme import MLS as MLS
from pgjax.transfer.scheme import AbstractScheme as AbstractScheme
from pgjax.transfer.scheme import SplineGradient as SplineGradient
