// What is behind an image, and losses of its pixels. Compiled once per instruction set, with strict IEEE rules.
#include "sky.hpp"

#include "kernels.h"
#include "pixel_losses.hpp"

namespace SPLAT_VARIANT {
namespace {

template <class T>
SkyKernels kernels() {
  return {[](const Sky& sky, const void* rgb, const void* alpha, void* out) {
            over_sky(sky, static_cast<const T*>(rgb), static_cast<const T*>(alpha), static_cast<T*>(out));
          },
          [](const Sky& sky, const void* alpha, const void* v_out, void* v_alpha, void* v_texels) {
            over_sky_backward(sky, static_cast<const T*>(alpha), static_cast<const T*>(v_out),
                              static_cast<T*>(v_alpha), static_cast<T*>(v_texels));
          }};
}

}  // namespace

void fill_sky_kernels(Kernels& k) {
  k.sky[0] = kernels<float>(), k.sky[1] = kernels<double>();
  k.losses[0] = {pixel_mean<float>, compare_colors<float>, compare_colors_backward<float>};
  k.losses[1] = {pixel_mean<double>, compare_colors<double>, compare_colors_backward<double>};
}

}  // namespace SPLAT_VARIANT
