"""One module a mechanism, or several alike: classes with a description, and their physics."""
