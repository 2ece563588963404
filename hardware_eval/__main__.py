"""``python -m hardware_eval`` is ``ventbench-hardware``."""

from hardware_eval.cli import main

main()
