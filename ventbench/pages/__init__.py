"""Pictures of scored runs: rerun files and an HTML report (extra ``ventbench[view]``)."""

from ventbench.pages.report import open_viewer, write_report, write_rerun

__all__ = ["open_viewer", "write_report", "write_rerun"]
