"""``python -m ventbench``, and the console scripts: the command line behind a guard for Ctrl-C."""

import os
import signal
from importlib import import_module


def main(program: str = "ventbench", module: str = "ventbench.cli") -> None:
    """Import a command line and run it; Ctrl-C ends the import with one line and 130.

    Args:
        program: what the line begins with.
        module: whose ``main`` runs the commands.
    """

    def stop(*_: object) -> None:
        os.write(2, f"{program}: stopped\n".encode())
        os._exit(130)

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, stop)
    # Work is spread over threads already: those of each linear algebra would wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import_module(module).main()


if __name__ == "__main__":
    main()
