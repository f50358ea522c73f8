"""From the results of calls to a table."""

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from pgjax.result import ERRORS, Status
from pgjax.sweeps.members import Members
from pgjax.sweeps.need import Need
from pgjax.sweeps.table import FAILED, OK, PENDING, WARNED, Table

# Of some members: `member` (their numbers), `substeps`, `dt`, `seconds`, `status.first`,
# `status.count` and `measured.NAME`, each with one entry per member.
Results = dict[str, np.ndarray]
MEASURED = "measured."


def members_of(results: Sequence[Results]) -> set[int]:
    """The numbers of all members in the results."""
    return {int(i) for found in results for i in found["member"]}


def tabulated(members: Members, need: Need, results: Sequence[Results]) -> Table:
    """One row per member, in their order, whatever order the results have."""
    count = len(members)
    status = np.full(count, PENDING, dtype="<U8")
    message = np.full(count, "", dtype=object)
    for i, error in need.errors.items():
        status[i], message[i] = FAILED, error
    for found in results:
        for row, i in enumerate(found["member"]):
            status[i], message[i] = _verdict(
                Status(
                    jnp.asarray(found["status.first"][row]),
                    jnp.asarray(found["status.count"][row]),
                )
            )
    spread = functools.partial(_spread, results, count)
    names = dict.fromkeys(n for found in results for n in found if n.startswith(MEASURED))
    measured = {name.removeprefix(MEASURED): spread(name) for name in names}
    columns = {
        **members.values,
        **{name: a for name, a in measured.items() if a.ndim == 1},
        "status": status,
        "message": message,
        **{name: spread(name) for name in ("dt", "substeps", "seconds")},
    }
    arrays = {name: a for name, a in measured.items() if a.ndim > 1}
    return Table(columns, arrays, tuple(members.values), members.shape)


def _verdict(status: Status) -> tuple[str, str]:
    messages = status.messages()
    verdict = FAILED if status.messages(ERRORS) else WARNED if messages else OK
    return verdict, " ".join(messages)


def _spread(results: Sequence[Results], count: int, name: str) -> np.ndarray:
    """What the results have of a name, at the numbers of the members; NaN elsewhere."""
    parts = [found for found in results if name in found]
    if not parts:
        return np.full(count, np.nan)
    like = parts[0][name]
    kind = like.dtype if like.ndim > 1 or np.issubdtype(like.dtype, np.floating) else np.float64
    missing = np.nan if np.issubdtype(kind, np.floating) else 0
    whole = np.full((count, *like.shape[1:]), missing, kind)
    for found in parts:
        whole[found["member"]] = found[name]
    return whole
