"""Selection of the mechanisms that a recording needs."""
