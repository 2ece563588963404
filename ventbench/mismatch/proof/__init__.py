"""The proof on real recordings: what physics models of a ventilator lack on the real rig."""

from ventbench.mismatch.proof.claims import Claim
from ventbench.mismatch.proof.parts import PARTS
from ventbench.mismatch.proof.run import Proof, prove

__all__ = ["PARTS", "Claim", "Proof", "prove"]
