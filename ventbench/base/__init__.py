"""What every room uses and what knows nothing of lungs: errors, files, text, work in parallel."""

#: Version of ventbench.
VERSION = "0.2.0"
