"""What the workflows of the repository call: everything they decide is here, and tested.

The folder stays in the repository; the wheel does not have it. Each job runs from a checkout as
``python -m ci.NAME``.

A pull request is data. Its commit is fetched into a repository of its own, never checked out; what
is not a plain small file in ``submissions/NAME/`` is refused.

- :mod:`ci.git`: git without hooks, attributes, configuration or endless output;
- :mod:`ci.take`: a submission out of an exact commit;
- :mod:`ci.workflow`: variables, summaries and exit codes of a job;
- :mod:`ci.advisory`: what a pull request's author is told;
- :mod:`ci.official`: the score that a maintainer starts, as a record;
- :mod:`ci.seed`: the seed of a season of hidden draws, to the scorer and to nobody else;
- :mod:`ci.propose`: the record into the leaderboard, on a branch;
- :mod:`ci.publish`: the leaderboard as a branch of pages.
"""
