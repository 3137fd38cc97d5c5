"""The splat op on GPUs, in Triton. Stages of one rendering, and the files they are in:

1. rows: each row to a record of 12 numbers, its radius and its number of tiles (``rows``, ``shape``, ``lens`` or
   ``unscented``, ``shutter``, ``harmonics``, ``tiles``);
2. lists: visible rows by depth, pairs by tile (``lists``); here the host waits once, for the number of pairs;
3. pixels: each tile's splats into its 256 pixels (``blend``), those of long tiles in parts (``parts``, ``thin``;
   ``programs`` says who does what), or counters of them (``count``, ``leave_one_out``);
4. backward: pixels to a slot per pair (``blend_backward``), slots to rows (``slots``), rows to parameters
   (``rows_backward``, and the backward halves beside each formula).

``screen`` runs the first two stages, ``pixels`` the third and the first half of the fourth. ``rasterizer`` makes an
autograd function of them. ``quaternions`` and ``vectors`` serve all formulas.

Other parts of a training step have a file each: ``poses`` and ``activate`` before the op, ``sky`` and ``ssim`` after
it, and ``adam``.

There are no atomics, so two runs agree to the last bit, except for the texels of the sky (``sky``). Nothing here is
imported before backend "triton" is used.
"""
