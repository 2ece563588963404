"""The paper's stitched network as a plant."""

from ventbench.plants.learned.architecture import Architecture as Architecture
from ventbench.plants.learned.architecture import Normalisation as Normalisation
from ventbench.plants.learned.boundary import Boundary as Boundary
from ventbench.plants.learned.build import learned as learned
from ventbench.plants.learned.plant import HIGHEST as HIGHEST
from ventbench.plants.learned.plant import LOWEST as LOWEST
from ventbench.plants.learned.plant import REFERENCE_DT as REFERENCE_DT
from ventbench.plants.learned.plant import Learned as Learned
from ventbench.plants.learned.plant import LearnedState as LearnedState
