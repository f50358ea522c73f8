"""Hard cases: what must not break, whatever the material."""
