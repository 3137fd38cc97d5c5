"""The scene: nodes of Gaussians, from their first points to the scene file. In reading order:

1. What a scene is. ``graph`` holds nodes and effects by name and returns all Gaussians of a view. ``nodes`` has a
   module for each node class and its settings. ``effects`` has what cameras and light do to the image (sky, lens,
   shutter), each with its settings. ``state`` says how far training is.
2. From a view to an image. ``rendering`` gets the Gaussians from the graph, calls the splat op as its options (in
   ``state``) say, and applies the effects to the image. Effects that change the view come first, in the graph.
   ``lidar`` draws ranges along rays in the same way, and ``surroundings`` makes a mesh of depths.
3. What a node consists of. It has a table of Gaussians (``gaussians``), whose rows change only by a ``RowPlan``. It has
   a mask (``masks``), density control (``density``) and learning rates (``learning_rate``). ``body`` has the
   formulas of people.
4. How it starts. ``build`` gives each object to a node and builds the effects that the log calls for. Then it
   triangulates points once, and calls the ``build`` of each node, which takes its points from ``initialize``.
   Every part draws from its own random stream (``generators``).
5. What stays. ``storage`` writes and reads the scene file (settings as JSON by ``loaded_scene``), ``street_file`` a
   small one, ``views`` the cameras of the log. ``edits`` changes a finished scene: objects removed, moved, added.

Training, pruning, evaluation and export import this room. It imports triangulation, logs, the op and
what lies below them. It knows no configuration.
"""
