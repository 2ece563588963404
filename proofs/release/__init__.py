"""What is run once for a release of the official simulators, and never by who uses them."""
