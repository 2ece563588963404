"""Fitting the hybrid plant to recordings of all settings at once."""
