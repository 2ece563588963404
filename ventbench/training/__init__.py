"""Learning simulators and controllers."""
