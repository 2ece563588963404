"""Plants: everything that answers to valve commands with a pressure."""
