"""Recordings of other laboratories: any table of waveforms becomes breaths in the public schema."""

from ventbench.recordings.foreign.convert import Imported as Imported
from ventbench.recordings.foreign.convert import import_recording as import_recording
from ventbench.recordings.foreign.convert import import_runs as import_runs
