"""Write ``rig.npz``: what is known of a rig before its first breath, from the training rigs."""

from pathlib import Path

import numpy as np
from rig import KNOTS, TOP

from ventbench.plants import frozen
from ventbench.plants.hybrid import ELASTIC_KNOTS


def main():
    official = frozen.load()
    plants = official.sessions_plants
    leaf = {name: np.asarray(getattr(plants, name), float) for name in plants.__dataclass_fields__}
    training = official.training_rigs
    used = sorted({session for rigs in training for session in rigs})

    def pooled(name):
        return float(np.median(leaf[name][:, used]))

    slopes = np.median(leaf["slopes"][:, used], axis=(0, 1))
    curve = np.concatenate([[0.0], np.cumsum(slopes * np.diff(KNOTS))])
    recoils, means = [], []
    above = np.arange(TOP + 1.0)
    for rigs in training:
        stiffening = leaf["stiffening"][:, rigs].mean(axis=(0, 1))
        bend = np.maximum(above[:, None] - np.asarray(ELASTIC_KNOTS), 0.0)
        recoils.append(above + bend @ stiffening)
        logs = [np.log(leaf[name][:, rigs]).mean() for name in ("R", "K2", "E")]
        closing = np.log(leaf["closing_conductance"][:, rigs]).mean()
        delay = leaf["valve_delay"][:, rigs].mean() + 0.265 * 0.03  # and the mean of a draw's
        offset = leaf["offset"][:, rigs].mean()
        means.append([*logs, 0.0, 0.0, 0.0, closing, delay, 5.0, offset])
    np.savez(
        Path(__file__).parent / "rig.npz",
        curve=curve,
        recoil=np.array(recoils),
        means=np.array(means),
        direction=np.median(leaf["direction"][:, used], axis=(0, 1)),
        lag=pooled("valve_lag"),
        circuit=pooled("circuit_compliance"),
        sensor_lag=pooled("sensor_lag"),
        rising=pooled("rising"),
        falling=pooled("falling"),
        closing_delay=pooled("closing_delay"),
        closing_lag=pooled("closing_lag"),
        rest=pooled("rest"),
    )


if __name__ == "__main__":
    main()
