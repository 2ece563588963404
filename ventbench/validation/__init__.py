"""Proofs that the diagnosis works: sealed challenges, and the real rig."""
