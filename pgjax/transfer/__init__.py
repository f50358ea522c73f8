"""Particle–grid transfers."""

from pgjax.transfer.scheme import MLS as MLS
from pgjax.transfer.scheme import AbstractScheme as AbstractScheme
from pgjax.transfer.scheme import SplineGradient as SplineGradient
from pgjax.transfer.transfers import Payload as Payload
from pgjax.transfer.transfers import Stencil as Stencil
from pgjax.transfer.transfers import gather as gather
from pgjax.transfer.transfers import scatter as scatter
from pgjax.transfer.transfers import stencil as stencil
