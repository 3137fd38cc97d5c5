"""The splat op on GPUs, in Triton. Stages of one rendering, and the files they are in:

1. rows: each row to a record of 12 numbers, its radius and its number of tiles (``project``, with ``cameras``);
2. lists: visible rows by depth, pairs by tile (``lists``), tiles in their order and in parts (``parts``); here the host
   waits once, for the number of pairs;
3. pixels: each tile's splats into its 256 pixels (``blend``), or counters of them (``counters``);
4. backward: pixels to a slot per pair, slots to rows, rows to parameters (``gradients``).

``view`` holds the camera and the layout of records. ``screen`` runs the first two stages, ``pixels`` the third and the
first half of the fourth. ``rasterizer`` makes an autograd function of them. ``quaternions`` serve all formulas.

Other parts of a training step have a file each: ``poses`` and ``activate`` before the op, ``sky``, ``ssim``,
``photometric`` and ``pixel_losses`` after it, then ``statistics`` and ``adam``.

There are no atomics, so two runs agree to the last bit, except for the texels of the sky (``sky``). Nothing here is
imported before backend "triton" is used.
"""
