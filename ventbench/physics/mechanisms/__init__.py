"""One module a mechanism: its description and its physics, as ``MECHANISM``."""
