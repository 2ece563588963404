"""The wire between host and device: messages, their parser, and the host's end of it."""

from ventbench.base.errors import require

require("cobs", "serial", extra="hardware", what="the wire and its device")
