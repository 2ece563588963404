"""When a recording and a simulator differ: where, why, by which physics, and how much it helps."""
