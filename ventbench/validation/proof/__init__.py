"""The proof on real recordings: what physics models of a ventilator lack on the real rig."""

from ventbench.validation.proof.claims import Claim
from ventbench.validation.proof.parts import PARTS
from ventbench.validation.proof.run import Proof, prove

__all__ = ["PARTS", "Claim", "Proof", "prove"]
