"""Training: one scene, one Adam, and callbacks that change the scene's rows. In reading order:

1. ``run`` is one training from start to end: build, resume, fit, evaluate, record;
2. ``recipe`` holds all parts of a training before any data is read, and what its records call it. It names parts
   without their counterpart, and its ``build`` calls ``scene.build`` and wraps the scene in a system;
3. ``system`` is the LightningModule. Its step renders a view, sums the ``losses`` and the regularizers of nodes and
   effects, and logs; it never changes rows;
4. ``callbacks`` decide when rows change: density control, masks, pruning. Strategies, masks and rules decide what. All
   changes go through ``resize_rows``, which applies a ``RowPlan`` to values and optimizer moments;
5. ``schedule`` has the intervals and milestones, ``optimizer`` the groups of learning rates, ``adam`` the Adam
   that leaves rows alone whose gradient is not finite (``nonfinite`` counts them), and one that moves
   only the rows a step has seen; ``forecast`` what a run will take and took.
"""
