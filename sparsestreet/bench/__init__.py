"""What the splat op costs in time, memory and accuracy: ``sparsestreet bench``. In reading order:

1. what is drawn: random splats in a frustum (``frustum``), a proxy scene for a street (``street``), the five scenes
   (``scenes``), each through a lens or a shutter (``effects``);
2. how it is measured: repeated timings and their spread (``timing``), errors of image and gradients against a truth
   (``accuracy``), identity of what culling leaves out (``culling``), kernels and memory of a device
   (``device_profile``), a straight line (``fit``);
3. beside what: vectorized torch (``torch_tiles``), gsplat (``gsplat_peer``), the C++ library with other tiles
   (``tile_sizes``);
4. the modes: ``blend`` (stages beside torch and the arithmetic floor), ``knobs`` (what is varied) and ``sweep`` (what
   that costs), ``scaling`` (time against work), ``gpu`` (a CUDA device beside gsplat).

``records`` writes a JSON object a line for each measurement; ``figures`` draws from those lines.
"""
