"""Pictures of a diagnosis: HTML report, rerun file and figure (extra ``ventbench[view]``)."""
