"""The wire between host and device: messages, their parser, and the host's end of it."""

from importlib.util import find_spec

from ventbench.base.errors import InputError

if missing := [package for package in ("cobs", "serial") if find_spec(package) is None]:
    raise InputError(
        f"the wire needs {' and '.join(missing).replace('serial', 'pyserial')}, which this "
        "installation lacks: pip install 'ventbench[hardware]'"
    )
