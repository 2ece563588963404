"""Ablations: variants of a design that differ from a base in one thing."""
