"""Which mechanisms a recording needs: screening, refits, gates on held-out breaths, slots."""
