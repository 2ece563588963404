"""Thresholds of the diagnosis."""

#: Log-likelihood on held-out breaths, nats, from which a term is accepted: log(1 / 0.01).
GATE = 4.6
