"""Controllers: what they are, the PID, the hard-coded expiration."""
