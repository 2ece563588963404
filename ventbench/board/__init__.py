"""The leaderboard: immutable records, ranks, and pages built from nothing else.

- :mod:`~ventbench.board.canonical`: the one text of a JSON value, its hash, and file names;
- :mod:`~ventbench.board.schema`: what a record's JSON must look like;
- :mod:`~ventbench.board.record`: a record as arrays; :mod:`~ventbench.board.create` makes one;
- :mod:`~ventbench.board.replay`: recorded commands through the frozen simulators again;
- :mod:`~ventbench.board.store`: the folder ``leaderboard/``, commands of scored runs without loss;
- :mod:`~ventbench.board.attestation`: who vouches for a record;
- :mod:`~ventbench.board.gate`: what may be ranked;
- :mod:`~ventbench.board.ranking`: which record of an entry counts, ranks, intervals, differences;
- :mod:`~ventbench.board.frames`: the columns of the board, its CSV and pandas frames;
- :mod:`~ventbench.board.build`: the site, with :mod:`~ventbench.board.pages`;
- :mod:`~ventbench.board.official_runs`: rounds are scored, and code of records runs again;
- :mod:`~ventbench.board.verify`: all that files can show, again.
"""
