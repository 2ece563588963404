"""Training of the learned plant: one-step loss first, then open-loop runs of growing length."""

from ventbench.training.learned.data import Inspirations as Inspirations
from ventbench.training.learned.data import expiratory_time_constant as expiratory_time_constant
from ventbench.training.learned.data import inspirations as inspirations
from ventbench.training.learned.data import normalisation as normalisation
from ventbench.training.learned.fit import CHUNK as CHUNK
from ventbench.training.learned.fit import fit as fit
from ventbench.training.learned.recipe import Progress as Progress
from ventbench.training.learned.recipe import Recipe as Recipe
