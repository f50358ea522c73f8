"""`pgjax fit`: case files, recorded data, reports."""

from pgjax.cases.schema import CaseFile as CaseFile
from pgjax.cases.schema import read_case as read_case
from pgjax.cases.solve import Prepared as Prepared
from pgjax.cases.solve import prepare as prepare
from pgjax.cases.solve import solve as solve
