"""The wire between host and device: messages, their parser, and the host's end of it."""
