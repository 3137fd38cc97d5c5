"""Training: one scene, one Adam, and callbacks that change the scene's rows. In reading order:

1. ``run`` is one training from start to end: build, resume, fit, evaluate, record;
2. ``recipe`` holds all parts of a training before any data is read. Its ``build`` builds the scene and wraps it in a
   system;
3. ``system`` is the LightningModule. Its step renders a view, sums the ``losses`` and the regularizers of nodes and
   effects, and logs; it never changes rows. ``moved_views`` has the terms of views beside the recorded path;
4. ``callbacks`` decide when rows change: density control, masks, pruning. Strategies, masks and rules decide what. All
   changes go through ``callbacks.density_control.resize_rows``, which applies a ``RowPlan`` to values and optimizer
   moments. Further callbacks write the files of a run and watch;
5. ``schedule`` has the intervals and milestones, ``optimizer`` the groups of learning rates. ``adam`` leaves rows alone
   whose gradient is not finite (``nonfinite`` counts them), or steps only the rows a view has seen. ``forecast`` says
   what a run will need, ``parallel`` whether all processes train the same scene, ``lightning`` what its trainer holds.
"""
