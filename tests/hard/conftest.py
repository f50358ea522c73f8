"""What held is kept beside each test, for a table of case, material and precision."""

import jax.numpy as jnp
import pytest


@pytest.fixture
def holds(request):
    """`holds(case, outcome="holds", material="any")`: keep the outcome of a hard case.

    The outcome is "holds", "refused" (an error that names the argument) or "status: CONDITION".
    """

    def keep(case, *, outcome="holds", material="any", precision=None):
        row = {
            "case": case,
            "material": material,
            "precision": precision or jnp.zeros(()).dtype.name,
            "outcome": outcome,
        }
        request.node.user_properties.append(("hard", row))

    return keep
