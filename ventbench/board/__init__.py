"""The leaderboard: immutable records, a chain over them, pages built from nothing else.

- :mod:`~ventbench.board.canonical`: the one text of a JSON value, and its hash;
- :mod:`~ventbench.board.actions`: every command of a scored run, without loss;
- :mod:`~ventbench.board.record`: what a record holds; :mod:`~ventbench.board.create` makes one;
- :mod:`~ventbench.board.replay`: recorded commands through the frozen simulators again;
- :mod:`~ventbench.board.chain`, :mod:`~ventbench.board.store`: the folder ``leaderboard/``;
- :mod:`~ventbench.board.fit`: whether records fit together;
- :mod:`~ventbench.board.standing`: which record of an entry counts, and why one is not ranked;
- :mod:`~ventbench.board.ranking`: ranks, intervals, differences;
- :mod:`~ventbench.board.build`: CSV and pages; :mod:`~ventbench.board.verify`: everything again.
"""
