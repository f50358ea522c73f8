"""Sweeps: many members of one scene in one compiled program, and a table of what came of them."""

from pgjax.sweeps.outcome import outcome as outcome
from pgjax.sweeps.sweep import sweep as sweep
from pgjax.sweeps.table import Table as Table
