"""What the workflows of the repository call: everything they decide is here, and tested.

The folder stays in the repository; the wheel does not have it. Each job runs from a checkout as
``python -m ci.NAME``.

A pull request is data. Its commit is fetched into a repository of its own, never checked out; what
is not a plain small file in ``submissions/NAME/`` is refused.

- :mod:`ci.git`: git without hooks, attributes, configuration or endless output;
- :mod:`ci.take`: a submission out of an exact commit;
- :mod:`ci.workflow`: variables, summaries and exit codes of a job;
- :mod:`ci.advisory`: what a pull request's author is told;
- :mod:`ci.requests`: whose account asked for which entry of a round;
- :mod:`ci.propose`: a step of a round, and its records, onto a branch;
- :mod:`ci.apart`: that no change adds records together with what vouches for them;
- :mod:`ci.publish`: the leaderboard as a branch of pages.
"""
