"""Scoring protocol: every number that a score depends on besides simulators, draws and bounds.

What is scored is the airway pressure; controllers see readings of the sensor. The paper's score is
the error of the nominal cells on the reference rig of each lung; the ranked score is that of draws
on all of its rigs (:mod:`ventbench.task.draws`).
"""

from __future__ import annotations

#: Nominal control step, s (paper, appendix A.2).
DT = 0.03

#: Steps of one breath (20 breaths/min) and breaths of one run: 300 steps, 9 s.
BREATH_STEPS = 100
BREATHS = 3

#: Inspiration: the 34 steps of a breath with ``step * DT < 1 s``; only there a submission acts.
INSPIRATION_STEPS = 34

#: Breaths (counted from 0) that are scored; the first is ignored (paper, appendix A.2).
SCORED_BREATHS = (1, 2)

#: Positive end-expiratory pressure, cmH2O.
PEEP = 5.0

#: Peak inspiratory pressures of the six runs a lung, cmH2O.
PIPS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)

#: Key points of the target, s: PIP until ``FALL_START``, then linear to PEEP at ``FALL_END``.
FALL_START = 1.0
FALL_END = 1.5

#: Range of the inspiratory valve, and step of a controller's command, %: a hundredth of what any
#: valve resolves, so that a record holds commands as whole numbers and loses nothing.
U_MAX = 100.0
RESOLUTION = 0.001

#: How many targets ahead of now an observation holds.
TARGETS_AHEAD = 10

#: What an entry may take of a round, s, on the clock and of processor time: all of its tracks,
#: seeds and stressed runs together. Whoever sleeps loses alone.
ENTRY_S = 900.0

#: Safety gate of a breath: at most ``SAFETY_TIME`` s in all above ``min(SAFETY_PRESSURE, PIP +
#: SAFETY_MARGIN)`` cmH2O, and no sample above ``SAFETY_CAP``; else the entry fails on that lung.
SAFETY_PRESSURE = 60.0
SAFETY_MARGIN = 15.0
SAFETY_TIME = 0.1

#: What a relief valve that opens at ``SAFETY_PRESSURE`` leaves, cmH2O: one that passes 200 mL/s per
#: cmH2O takes the flow of the fully open inspiratory valve, 2.28 L/s, within about 10 cmH2O.
#: It is also the highest plateau that the specification of emergency ventilators admits (MHRA,
#: RMVS001, 2020); their last valve opens at 80, and ISO 80601-2-12 bars 125 even under a fault.
SAFETY_CAP = 70.0
