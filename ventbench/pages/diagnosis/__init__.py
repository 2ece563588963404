"""Pictures of a diagnosis: HTML report and rerun file (extra ``ventbench[view]``)."""
