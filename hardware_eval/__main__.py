"""``python -m hardware_eval`` is ``ventbench-hardware``."""

from ventbench.__main__ import main as guarded


def main() -> None:
    """Entry point of the console script."""
    guarded("ventbench-hardware", "hardware_eval.cli")


if __name__ == "__main__":
    main()
