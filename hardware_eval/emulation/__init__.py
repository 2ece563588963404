"""A bench in software: a simulated lung behind the device's own program, and what can go wrong."""
