"""Pictures of a diagnosis: an HTML report and a rerun file (extra ``ventbench[view]``)."""

from ventbench.views.diagnosis.write import write_report, write_rerun

__all__ = ["write_report", "write_rerun"]
