"""What a trained scene is worth, measured where the run is, and the tables that compare runs.

``run`` measures a scene and writes a run's files, with ``evaluate`` (renders against images) and ``speed``: only these
see torch. The rest reads and writes what lies on disk: ``records`` (what identifies a run, what was measured of it),
``quality_csv`` and ``ledger``, all through ``strict_json``; ``configuration`` says which runs are repeats and in what
others differ; ``report`` makes tables, ``compare`` sheets of runs' ``pictures``, ``history`` the curves of one.
"""
