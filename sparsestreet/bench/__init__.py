"""What the splat op costs in time, memory and accuracy: ``sparsestreet bench``. In reading order:

1. Scenes: random splats in a frustum (``frustum``), a proxy scene for a street (``street``), the five scenes of the
   sweep (``scenes``), each also through a lens or a shutter (``effects``).
2. Measurements: repeated timings and their spread (``timing``), errors of image and gradients (``accuracy``), a check
   that culling changes nothing (``culling``), kernels and memory of a device (``device_profile``), a line fit
   (``fit``).
3. Peers: vectorized torch (``torch_tiles``), gsplat (``gsplat_peer``), the C++ library with other tiles
   (``tile_sizes``).
4. Modes: ``blend`` compares stages with torch and the arithmetic floor. ``knobs`` lists what is varied, ``sweep``
   measures what that costs. ``scaling`` is time against work. ``gpu`` compares a CUDA device with gsplat.

``records`` writes one JSON line per measurement; ``figures`` draws from those lines.
"""
