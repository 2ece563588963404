"""One module an event: what happens to a circuit in operation, as ``MECHANISM``.

They have the interface of the mechanisms of the library. No fit searches for them; stress tests
and whoever names their parameters use them.
"""
