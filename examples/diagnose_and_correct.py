"""Find what a simulator lacks in a recording, correct it, and tune a PID on the corrected one."""

from pathlib import Path

import ventbench

OUT = Path("runs/diagnose_and_correct")

# A recording whose lung has an effect that the simulator `physics` knows nothing of.
recording = ventbench.load_recording(ventbench.example("concealed"))
print(recording)

diagnosis = ventbench.diagnose(recording, simulator="physics")
print(diagnosis)  # what is missing, how sure, what mending it is worth
diagnosis.save(OUT)  # a page to read, a corrected simulator, what to record next

# The corrected simulator goes wherever a simulator goes: into scores, tuning and training.
(lung,) = recording.by_lung_index
corrected = OUT / "corrected.json"
gains = [(p, i, 0.0) for p in (0.5, 1.0, 2.0, 4.0) for i in (1.0, 2.0, 4.0, 8.0)]  # %/cmH2O
for name, simulator in [("as given", "physics"), ("corrected", corrected)]:
    grid, _ = ventbench.tune_pid([lung], simulator=simulator, gains=gains, draws=0)
    best, error = grid.best(lung)
    print(f"best PI on the simulator {name}: P, I, D = {best}, error {error:.3f} cmH2O")
print(f"open {OUT}/report.html")
