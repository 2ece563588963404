"""Figures that the paper prints: Suo et al., arXiv:2102.06779.

The paper's pictures carry no numbers in the text. Of those only the claim can be compared, which
stands with each section in the modules beside this one.
"""

from __future__ import annotations

#: Open-loop mean absolute error on held-out recordings of the real lung, cmH2O (appendix B.1).
OPEN_LOOP = {
    "R5C10": 0.64,
    "R5C20": 0.72,
    "R5C50": 0.39,
    "R20C10": 0.72,
    "R20C20": 0.60,
    "R20C50": 0.85,
}

#: Best P, I, D of the grid on the physical lung, %/cmH2O (appendix A.2).
BEST_PID = {
    "R5C10": (10.0, 0.2, 0.0),
    "R5C20": (10.0, 10.0, 0.0),
    "R5C50": (10.0, 10.0, 0.0),
    "R20C10": (8.0, 1.0, 0.0),
    "R20C20": (5.0, 10.0, 0.0),
    "R20C50": (5.0, 10.0, 0.0),
}

#: Architecture search on R5C10: open-loop error, cmH2O, by setting and value (appendix B.1).
ARCHITECTURES = {
    "depth": {3: 0.696, 6: 0.649, 9: 0.643},
    "N_B": {1: 0.643, 3: 0.677, 5: 0.718},
    "H_p": {3: 0.649, 5: 0.643, 10: 0.648},
    "width": {50: 0.679, 100: 0.651, 150: 0.643},
    "H_c": {3: 0.676, 5: 0.648, 10: 0.643},
}

#: Trajectories of one lung in the grid: 20 values of P, 20 of I, six waveforms.
TRAJECTORIES = 2400

#: Trials with other hyper-parameters (section 6).
TRIALS = {"PPO": 720, "DQN": 180}
