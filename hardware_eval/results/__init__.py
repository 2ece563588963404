"""From runs on a bench to records, replays and comparisons with simulators."""
