"""The diagnosis on real recordings: known effects on the real rig, and pairs that differ."""
