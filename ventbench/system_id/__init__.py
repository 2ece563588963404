"""System identification: data, noise, predictions, least squares, fits and their intervals."""

from ventbench.system_id.data import Data as Data
from ventbench.system_id.data import Noise as Noise
from ventbench.system_id.data import make_data as make_data
from ventbench.system_id.data import robust_noise as robust_noise
from ventbench.system_id.fit import Fit as Fit
from ventbench.system_id.fit import fit as fit
from ventbench.system_id.fit import interval as interval
from ventbench.system_id.fit import likely_places as likely_places
from ventbench.system_id.fit import profile_interval as profile_interval
from ventbench.system_id.predictor import START as START
from ventbench.system_id.predictor import Predictor as Predictor
from ventbench.system_id.problem import Unknowns as Unknowns
from ventbench.system_id.problem import make_unknowns as make_unknowns
from ventbench.system_id.problem import parameter_values as parameter_values
