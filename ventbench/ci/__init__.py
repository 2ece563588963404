"""What the workflows of the repository call: everything they decide is here, and tested.

A pull request is data. Its commit is fetched into a repository of its own, never checked out; what
is not a plain small file in ``submissions/NAME/`` is refused.

- :mod:`~ventbench.ci.git`: git without hooks, attributes, configuration or endless output;
- :mod:`~ventbench.ci.take`: a submission out of an exact commit;
- :mod:`~ventbench.ci.advisory`: what a pull request's author is told;
- :mod:`~ventbench.ci.official`: the score that a maintainer starts, as a record;
- :mod:`~ventbench.ci.propose`: the record into the leaderboard, on a branch;
- :mod:`~ventbench.ci.publish`: the leaderboard as a branch of pages.
"""
