"""Which breaths to record next, so that two explanations can be told apart."""

from ventbench.diagnosis.next_breath.candidates import Family, Rig, families
from ventbench.diagnosis.next_breath.information import Fitted
from ventbench.diagnosis.next_breath.request import request

__all__ = ["Family", "Fitted", "Rig", "families", "request"]
