"""What runs in the locked-down processes; the standard library and light modules alone.

Nothing here may import numpy, JAX or a part of ventbench that does: the zygote would hold it, and
every cell with it.
"""
