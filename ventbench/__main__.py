"""``python -m ventbench``: the command line."""

from ventbench.cli import main

main()
