"""One module a place in the rig: classes with a description, and their physics."""
