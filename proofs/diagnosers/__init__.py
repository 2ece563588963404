"""Diagnosers of the challenge, one a file: ``diagnose(folder)`` returns the answer.

``ventbench`` is the project's own; the others are its rivals, made from their publications. None of
them knows the judge, and the judge knows none of them.
"""
