"""Recordings of breaths: the public schema, checks, CSV and Parquet in and out."""

from ventbench.recordings.breaths import Breaths as Breaths
from ventbench.recordings.breaths import join as join
from ventbench.recordings.breaths import make_breaths as make_breaths
from ventbench.recordings.read import check as check
from ventbench.recordings.read import load as load
from ventbench.recordings.read import recordings_dir as recordings_dir
from ventbench.recordings.report import RecordingReport as RecordingReport
from ventbench.recordings.roles import Finding as Finding
from ventbench.recordings.roles import Saturation as Saturation
from ventbench.recordings.roles import check_roles as check_roles
from ventbench.recordings.roles import find_saturation as find_saturation
from ventbench.recordings.roles import require_roles as require_roles
from ventbench.recordings.schema import COLUMNS as COLUMNS
from ventbench.recordings.schema import Column as Column
from ventbench.recordings.schema import RecordingError as RecordingError
from ventbench.recordings.schema import RecordingProblem as RecordingProblem
from ventbench.recordings.write import write as write
