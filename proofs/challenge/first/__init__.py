"""The first generator of concealed recordings: its plan of cases, its rig and its instruments."""
