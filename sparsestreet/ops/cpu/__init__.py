"""The C++ backend: rows of Gaussians, their blending and gradients, images; the sources are in ``src``.

``library`` finds and loads it and declares its C interface (src/interface.h). ``rows`` activates and places Gaussians
(src/rows.cpp), ``rasterizer`` projects and blends them and calls the backward pass (src/pixels.cpp, by
splat_backward in src/library.cpp), ``images`` has the sky and D-SSIM.
"""
