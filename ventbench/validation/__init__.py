"""Proofs of the diagnosis: concealed challenges, and the real rig."""
