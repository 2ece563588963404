"""Recordings of breaths: the public schema, checks, CSV and Parquet in and out."""

from ventbench.recordings.breaths import Breaths as Breaths
from ventbench.recordings.breaths import join as join
from ventbench.recordings.breaths import make_breaths as make_breaths
from ventbench.recordings.breaths import write as write
from ventbench.recordings.read import check as check
from ventbench.recordings.read import load as load
from ventbench.recordings.read import recordings_dir as recordings_dir
from ventbench.recordings.roles import check_roles as check_roles
from ventbench.recordings.roles import find_saturation as find_saturation
from ventbench.recordings.roles import require_roles as require_roles
from ventbench.recordings.schema import RecordingError as RecordingError
