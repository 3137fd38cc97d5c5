"""What a trained scene is worth, measured where the run is.

``run`` measures a scene and writes a run's files, with ``evaluate`` (renders against images), ``speed`` and
``node_costs``; ``extra`` measures what somebody asks for beside them. What the files hold is in ``records``.
"""
