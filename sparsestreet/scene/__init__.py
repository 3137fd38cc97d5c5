"""The scene: nodes of Gaussians, from their first points to the scene file. In reading order:

1. What a scene is. ``graph`` holds the nodes by name and returns all Gaussians of a view. ``nodes`` has a module for
   each node class and its settings. ``effects`` has what cameras and light do to the image (sky, lens, shutter).
   ``state`` says how far training is.
2. From a view to an image. ``rendering`` asks the graph for Gaussians, calls the splat op and adds the effects, as
   ``options`` say.
3. What a node consists of. It has a table of Gaussians (``gaussians``), whose rows change only by a ``RowPlan``. It has
   a mask (``masks``), density control (``density``) and learning rates (``learning_rate``). ``body`` and ``vibration``
   have the formulas of people and of PVG.
4. How it starts. ``build`` gives each object to a node (``assignment``), calls ``triangulation`` once, and calls each
   node's ``build``. The latter takes its points from ``initialize``. Every part draws from its own random stream
   (``generators``).
5. What stays. ``storage`` writes and reads the scene file (settings as JSON by ``encoding``), ``views`` the cameras of
   the log. ``centers`` draws the Gaussians as dots.

Training, pruning and evaluation import this room. It imports the op, the log's types and ``triangulation``. It knows no
configuration.
"""
