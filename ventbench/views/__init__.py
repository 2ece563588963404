"""Pictures of scored runs: rerun files, an HTML report, a figure (extra ``ventbench[view]``)."""

from ventbench.views.viewer import open_viewer
from ventbench.views.write import write_figure, write_report, write_rerun

__all__ = ["open_viewer", "write_figure", "write_report", "write_rerun"]
