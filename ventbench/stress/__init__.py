"""Stress track: what a controller does when physics is missing that nobody told it about."""
